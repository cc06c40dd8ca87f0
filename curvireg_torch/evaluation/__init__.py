"""Evaluation on datasets: their objects, what the method is told of them, and the scores.

The command is ``curvireg evaluate pascal3d|bop|web ROOT --out DIR``. To add a dataset, write a
:class:`Benchmark` and add a row to ``registry.DATASETS``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
