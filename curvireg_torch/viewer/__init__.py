"""A local page that shows a registration and lets it be corrected: ``curvireg view``.

``server`` starts the page, ``page`` and ``panels`` lay it out, ``session`` computes (no
page needed), ``pictures`` and ``drawing`` are what its name says. NiceGUI is imported by ``server``, ``page`` and
``panels`` alone, when a page is started.
"""
