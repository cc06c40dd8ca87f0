"""Numerical helpers: computation dtype, and roots and quotients whose values and gradients stay finite."""

import math
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual


def safe_eps(x: Tensor) -> float:
    """Smallest positive number of x's dtype whose power -1.5, the derivative of ``rsqrt``, is finite with a margin."""
    return math.pow(torch.finfo(x.dtype).tiny, 0.6)


def safe_sqrt(x: Tensor) -> Tensor:
    """sqrt(max(x, 0)) with gradient 0 instead of inf where x <= 0."""
    tiny: float = torch.finfo(x.dtype).tiny
    return x.clamp(min=tiny).sqrt() - math.sqrt(tiny)


def squared_length(x: Tensor, y: Tensor) -> Tensor:
    """x^2 + y^2 as a new tensor."""
    return (x * x).addcmul_(y, y)


def clone_if_grad(x: Tensor) -> Tensor:
    """A tensor that may be changed in place: x itself, or a clone where autograd still needs its value."""
    return x.clone() if x.requires_grad else x


def full_precision(x: Tensor) -> AbstractContextManager[object]:
    """Disable autocast: a second derivative has no correct digit left in bfloat16."""
    device = x.device.type
    return torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext()


def at_least_float32(x: Tensor) -> Tensor:
    """Convert float16 and bfloat16 to float32, since squared derivatives exceed their range."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


def image_maximum(x: Tensor) -> Tensor:
    """(B, 1, 1, 1) maximum of each image."""
    return x.amax(dim=(1, 2, 3), keepdim=True)


def _in_func_transform(x: Tensor) -> bool:
    # torch has no public test for this; code that branches on values or writes into a tensor would fail under vmap.
    return torch._C._functorch.is_functorch_wrapped_tensor(x)


def is_host_readable(x: Tensor) -> bool:
    """Whether Python can read the values of x at no cost: a CPU tensor, not compiled, not in a ``torch.func`` call."""
    return not torch.compiler.is_compiling() and x.device.type == "cpu" and not _in_func_transform(x)


def is_traced(x: Tensor) -> bool:
    """Whether autograd, forward or backward, or ``torch.func`` follows x, so that x cannot be written to."""
    return x.requires_grad or _in_func_transform(x) or unpack_dual(x).tangent is not None
