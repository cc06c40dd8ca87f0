"""A local page that registers a photograph and lets the user correct the pose: ``curvireg view``.

:mod:`.session` computes and :mod:`.editing` moves poses; :mod:`.workspace` holds what a page works on, so that a reload
finds it again, and runs its jobs; :mod:`.uploads` identifies files and :mod:`.guard` checks requests: all without
NiceGUI. :mod:`.server` starts the page. :mod:`.page` lays it out from :mod:`.steps`, :mod:`.stage`, :mod:`.answers`,
:mod:`.inputs` and :mod:`.panels`, which show their workspace.
"""
