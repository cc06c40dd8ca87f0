"""A local page that registers a photograph and lets the user correct the pose: ``curvireg view``.

:mod:`.session` computes and :mod:`.editing` moves poses, without NiceGUI. :mod:`.server` starts the page, :mod:`.page`
lays it out from :mod:`.inputs` and :mod:`.panels`, which know only the protocol in :mod:`.host`.
"""
