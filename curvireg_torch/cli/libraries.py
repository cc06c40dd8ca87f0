"""Import of the large libraries that commands need."""

import gc
import os
import sys


def load_libraries() -> None:
    """Import torch and trimesh without a search for cycles among the 400,000 objects that they make
    and that stay: that takes 0.5 s."""
    if "torch" in sys.modules:
        return
    # matrices of ours are small: a second thread takes more time to wait than it saves
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.disable()
    try:
        import torch as torch
        import trimesh as trimesh
    finally:
        gc.freeze()
        gc.enable()
