"""Layers a few images at a time, so that what they compute stays in a CPU's cache."""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

__all__ = ["BLOCK", "Planes", "channels", "in_blocks"]

Planes = tuple[Tensor, ...]
"""The channels of a result, each (B, 1, H, W), or several of them together; of a descriptor (B, D), all of it."""

BLOCK = 2**18
"""Pixels that :func:`in_blocks` hands to a layer at once."""


def in_blocks(layer: Callable[..., Planes], *tensors: Tensor | None) -> Tensor:
    """``channels(*layer(*tensors))``, on a CPU a few images at a time so that what it computes stays in the cache.

    Only for layers that treat each image by itself. ``tensors`` share their first dimension; None stays None.
    """
    x = tensors[0]
    assert x is not None
    if torch.compiler.is_compiling() or x.device.type != "cpu" or x.numel() <= BLOCK:
        return channels(*layer(*tensors))
    size = max(1, BLOCK // x.shape[1:].numel())
    parts = [[None] * math.ceil(len(x) / size) if t is None else t.split(size) for t in tensors]
    blocks = (layer(*part) for part in zip(*parts, strict=True))
    first = next(blocks)
    if any(_traced(plane) for plane in first):
        return torch.cat([channels(*planes) for planes in itertools.chain([first], blocks)])
    # One block in memory at a time.
    out = first[0].new_empty((len(x), sum(plane.shape[1] for plane in first), *first[0].shape[2:]))
    for place, planes in zip(out.split(size), itertools.chain([first], blocks), strict=True):
        torch.cat(planes, dim=1, out=place)
    return out


def _traced(x: Tensor) -> bool:
    """Whether autograd, forward or backward, or a transform of ``torch.func`` follows x: no writing into it then."""
    return x.requires_grad or torch._C._functorch.is_functorch_wrapped_tensor(x) or unpack_dual(x).tangent is not None


def channels(*planes: Tensor) -> Tensor:
    """(B, C, H, W) of C tensors (B, 1, H, W)."""
    if len(planes) == 1:
        return planes[0]
    # Compiled, a concatenation of single channels would be laid out channels last and transposed again.
    return torch.stack([plane.squeeze(1) for plane in planes], dim=1)
