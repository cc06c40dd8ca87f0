"""The large libraries of commands, without parts that no command uses."""

import gc
import os
import sys

from ..utils.modules import postponed_imports

# what torch, trimesh and scipy import: 0.4 s
UNUSED = (
    "torch._meta_registrations",  # of tensors without data, which torch.compile computes with
    "networkx",
    "scipy.optimize",
    "scipy.ndimage",
    "numpy.f2py",
    "cascadio",
)


def load_libraries() -> None:
    """Import torch and trimesh, after all that needs neither."""
    if "torch" in sys.modules:
        return
    # matrices of ours are small: a second thread takes more time to wait than it saves
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import numpy as numpy  # before its parts are postponed

    # 400,000 objects that stay: no search for cycles among them
    gc.disable()
    with postponed_imports(*UNUSED):
        import torch as torch
        import trimesh as trimesh
    gc.freeze()
    gc.enable()
