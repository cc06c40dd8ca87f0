"""A local page that registers photographs and lets the user correct the poses: ``curvireg view``.

Without NiceGUI, :mod:`.session` registers photographs, :mod:`.shot` holds one with its pose and
moves this by hand, and :mod:`.workspace` holds what the page works on, so that a reload finds it
again, runs its jobs and receives files. :mod:`.server` checks requests and starts the page.
:mod:`.page` lays it out from :mod:`.stage`, :mod:`.side` and :mod:`.widgets`. :mod:`.live` is the
page of ``curvireg follow --show``.
"""
