"""Process large batches a few images at a time, so that intermediate results stay in the CPU cache."""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from .numerics import is_traced

Planes = tuple[Tensor, ...]
"""Channels of a result: several tensors (B, 1, H, W), or one tensor that holds them all."""

BLOCK = 2**18
"""Pixels that :func:`apply_in_blocks` passes to a layer at once."""


def apply_in_blocks(layer: Callable[..., Planes], *tensors: Tensor | None) -> Tensor:
    """``stack_channels(*layer(*tensors))``, computed a few images at a time on a CPU.

    The layer must treat each image independently. All ``tensors`` have the same first dimension; None stays None.
    """
    x = tensors[0]
    assert x is not None
    if torch.compiler.is_compiling() or x.device.type != "cpu" or x.numel() <= BLOCK:
        return stack_channels(*layer(*tensors))
    size = max(1, BLOCK // x.shape[1:].numel())
    parts = [[None] * math.ceil(len(x) / size) if t is None else t.split(size) for t in tensors]
    blocks = (layer(*part) for part in zip(*parts, strict=True))
    first = next(blocks)
    if any(is_traced(plane) for plane in first):
        return torch.cat([stack_channels(*planes) for planes in itertools.chain([first], blocks)])
    # Only one block is in memory at a time.
    out = first[0].new_empty((len(x), sum(plane.shape[1] for plane in first), *first[0].shape[2:]))
    for target, planes in zip(out.split(size), itertools.chain([first], blocks), strict=True):
        torch.cat(planes, dim=1, out=target)
    return out


def stack_channels(*planes: Tensor) -> Tensor:
    """(B, C, H, W) from C tensors (B, 1, H, W)."""
    if len(planes) == 1:
        return planes[0]
    # A compiled concatenation of single channels is laid out channels-last and then transposed.
    return torch.stack([plane.squeeze(1) for plane in planes], dim=1)
