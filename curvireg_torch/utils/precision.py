"""Computation in full precision, whatever the caller's autocast."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch

DEVICES = ("cpu", "cuda", "mps", "xpu")


@contextmanager
def full_precision() -> Iterator[None]:
    """Within, and in functions with the decorator ``@full_precision()``, autocast is off on every
    device: scores of views differ by less than bfloat16 can tell apart, and threads would not
    inherit the caller's autocast anyway."""
    with ExitStack() as stack:
        for device in DEVICES:
            if torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        yield


@contextmanager
def exact_convolutions() -> Iterator[None]:
    """Within, GPUs compute convolutions in float32, not in TF32, whose 10 bits move poses."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
