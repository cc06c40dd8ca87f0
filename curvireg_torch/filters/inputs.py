"""Photographs as input of every layer and detector: colour, missing pixels, half precision."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from ..utils.checks import check_colour_image
from .blocks import Planes, apply_in_blocks
from .numerics import at_least_float32, is_host_readable

_PYRAMID_LEVELS = 5
"""Holes of up to 2^5 px are filled from their surroundings, the middle of larger ones with the mean of the image."""


def apply_to_photograph(layer: Callable[[Tensor], Planes], image: Tensor, *, missing_value: float = 0.0) -> Tensor:
    """Apply ``layer`` to grey levels; missing pixels are filled from their surroundings and give ``missing_value``."""
    check_colour_image(image)

    def on_filled(x: Tensor) -> Planes:
        if not may_have_missing(x):
            return layer(x)
        mask = missing_mask(x)
        return tuple(torch.where(mask, missing_value, plane) for plane in layer(fill_missing(x, mask)))

    return apply_in_blocks(on_filled, to_grey(at_least_float32(image))).to(image.dtype)


def to_grey(image: Tensor) -> Tensor:
    """(B, 1, H, W) grey levels of (B, 3, H, W) RGB, 0.299 R + 0.587 G + 0.114 B; a grey image is returned unchanged."""
    if image.shape[1] == 1:
        return image
    # kornia's rgb_to_grayscale has the same weights and rounds differently, which would change results.
    r, g, b = image.split(1, dim=1)
    grey: Tensor = 0.299 * r + 0.587 * g + 0.114 * b
    return grey


def may_have_missing(x: Tensor) -> bool:
    """False if all of x is known to be finite, at the cost of one sum; always True while tracing."""
    return not is_host_readable(x) or not math.isfinite(float(x.detach().sum()))


def missing_mask(x: Tensor) -> Tensor:
    """True where x is NaN or infinite."""
    return ~(x.abs() < math.inf)


def fill_missing(x: Tensor, mask: Tensor | None = None) -> Tensor:
    """Fill each missing pixel of (B, C, H, W) with the mean of the smallest pyramid cell that has any valid pixel.

    ``mask`` is True where a pixel is missing; None: where x is not finite. An image without valid pixels becomes 0.
    """
    if mask is None:
        if not may_have_missing(x):
            return x
        mask = missing_mask(x)
    sums, weights = [torch.where(mask, 0.0, x)], [(~mask).to(x.dtype)]
    for _ in range(_PYRAMID_LEVELS):
        sums.append(F.avg_pool2d(sums[-1], 2, ceil_mode=True))
        weights.append(F.avg_pool2d(weights[-1], 2, ceil_mode=True))
    tiny = torch.finfo(x.dtype).tiny
    fill = sums[-1].sum(dim=(2, 3), keepdim=True) / weights[-1].sum(dim=(2, 3), keepdim=True).clamp(min=tiny)
    for total, weight in zip(sums[:0:-1], weights[:0:-1], strict=True):
        coarser = fill[..., : weight.shape[-2], : weight.shape[-1]]
        fill = torch.where(weight > 0, total / weight.clamp(min=tiny), coarser)
        fill = F.interpolate(fill, scale_factor=2.0, mode="nearest")
    return torch.where(mask, fill[..., : x.shape[-2], : x.shape[-1]], x)


def zero_nonfinite_vectors(field: Tensor) -> Tensor:
    """(B, 2, H, W) with vectors that have a NaN or infinite component replaced by zero."""
    if not may_have_missing(field):
        return field
    return torch.where(missing_mask(field).any(dim=1, keepdim=True), 0.0, field)
