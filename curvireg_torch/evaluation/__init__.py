"""Evaluation on datasets: one loop writes predictions to disk, another scores what is there.

The command is ``curvireg evaluate pascal3d|bop|web ROOT --out DIR``; under ``torchrun`` the
processes share the objects.
To add a dataset, write a benchmark and add a row to :mod:`.registry`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
