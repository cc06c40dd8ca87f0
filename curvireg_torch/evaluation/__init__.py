"""Evaluation on datasets, and registration of lists of photographs.

Both become values of one type, ``runner.Entry``, which one resumable loop registers, in one process
or several, and whose results one store keeps. The command is
``curvireg evaluate pascal3d|bop|web ROOT --out DIR``. To add a dataset, write a :class:`Benchmark`
and add a row to ``registry.DATASETS``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
