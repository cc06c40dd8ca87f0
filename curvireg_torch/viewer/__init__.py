"""A local page that registers photographs and lets the user correct the poses: ``curvireg view``.

:mod:`.session` computes and moves poses, and :mod:`.workspace` holds what the page works on, so that a reload finds it
again, runs its jobs and receives files: both without NiceGUI. :mod:`.server` checks requests and starts the page.
:mod:`.page` lays it out from :mod:`.stage`, :mod:`.side` and :mod:`.widgets`. :mod:`.live` is the page of
``curvireg follow --show``.
"""
