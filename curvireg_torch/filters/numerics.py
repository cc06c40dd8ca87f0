"""Numbers: which dtype a layer computes in, and roots and quotients that stay finite, gradients included."""

import math
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

__all__ = [
    "at_least_float32",
    "floor",
    "full_precision",
    "image_maximum",
    "owned",
    "readable",
    "safe_sqrt",
    "squared_length",
]


def floor(x: Tensor) -> float:
    """A positive number next to nothing in x's dtype, whose powers -1.5 (of rsqrt's derivative) are finite."""
    return math.pow(torch.finfo(x.dtype).tiny, 0.6)


def safe_sqrt(x: Tensor) -> Tensor:
    """sqrt of max(x, 0) whose gradient is 0, not inf, where x <= 0."""
    tiny: float = torch.finfo(x.dtype).tiny
    return x.clamp(min=tiny).sqrt() - math.sqrt(tiny)


def squared_length(x: Tensor, y: Tensor) -> Tensor:
    """x^2 + y^2, a new tensor."""
    return (x * x).addcmul_(y, y)


def owned(x: Tensor) -> Tensor:
    """x, of which this is the last use, to be changed in place; a copy where autograd still wants its value."""
    return x.clone() if x.requires_grad else x


def full_precision(x: Tensor) -> AbstractContextManager[object]:
    """Switches autocast off: convolutions in bfloat16 would leave nothing of a second derivative."""
    kind = x.device.type
    return torch.autocast(kind, enabled=False) if torch.is_autocast_enabled(kind) else nullcontext()


def at_least_float32(x: Tensor) -> Tensor:
    """float16 and bfloat16 become float32: squared derivatives leave their range."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


def image_maximum(x: Tensor) -> Tensor:
    """(B, 1, 1, 1) maximum of each image's own pixels, detached from the batch around it."""
    return x.amax(dim=(1, 2, 3), keepdim=True)


def readable(x: Tensor) -> bool:
    """Whether Python may look at the numbers in x at no cost: not in a graph, not under vmap, not on another device."""
    return (
        not torch.compiler.is_compiling()
        and x.device.type == "cpu"
        and not torch._C._functorch.is_functorch_wrapped_tensor(x)
    )
