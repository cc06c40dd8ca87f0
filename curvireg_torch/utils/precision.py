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
    # From torch 2.9 on, the flag cannot be read after precision was chosen in the new way.
    holder = getattr(torch.backends.cudnn, "conv", torch.backends.cudnn)
    is_new = holder is not torch.backends.cudnn
    name, tf32, exact = (
        ("fp32_precision", "tf32", "ieee") if is_new else ("allow_tf32", True, False)
    )
    if getattr(holder, name) != tf32:
        yield  # a value that is set back would no longer follow torch.backends.fp32_precision
        return
    setattr(holder, name, exact)
    try:
        yield
    finally:
        setattr(holder, name, tf32)
