"""Evaluation on datasets, and registration of lists of photographs.

Both register :class:`~.runner.Entry` values in one resumable loop (:mod:`.runner`) and keep the results in one store
(:mod:`.store`), in one process or several. The command is ``curvireg evaluate pascal3d|bop|web ROOT --out DIR``.
To add a dataset, write a benchmark and add a row to :mod:`.registry`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
