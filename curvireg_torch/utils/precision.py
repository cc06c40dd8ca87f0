"""Computation in full precision, whatever the caller's autocast."""

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import ParamSpec, TypeVar

import torch

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
DEVICES = ("cpu", "cuda", "mps", "xpu")


@contextmanager
def full_precision() -> Iterator[None]:
    """Within, autocast is off on every device."""
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


def in_full_precision(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorator: ``function`` computes with autocast off. Scores of views differ by less than
    bfloat16 can tell apart, and threads would not inherit the caller's autocast anyway."""

    @functools.wraps(function)
    def computed(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with full_precision():
            return function(*args, **kwargs)

    return computed
