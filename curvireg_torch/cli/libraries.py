"""Import of the large libraries that commands need."""

import gc
import os
import signal
import sys

from ..utils.files import hangup_signals, signals_handled


def load_libraries() -> None:
    """Import torch and trimesh without a search for cycles among the 400,000 objects that they make
    and that stay: that takes 0.5 s. A signal that ends the process does so afterwards: an exception
    in the middle of numpy's import is lost in a recursion without end."""
    if "torch" in sys.modules:
        return
    # matrices of ours are small: a second thread takes more time to wait than it saves
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    ending = [signal.SIGINT, signal.SIGTERM, *hangup_signals()]
    received: list[int] = []
    gc.disable()
    try:
        with signals_handled(ending, lambda number, _: received.append(number)):
            import torch as torch
            import trimesh as trimesh
    finally:
        gc.freeze()
        gc.enable()
    if received:
        signal.raise_signal(received[0])
