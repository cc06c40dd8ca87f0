"""What comes in as a photograph, for every layer and detector: colour, missing pixels, half types."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from ..utils.checks import check_colour_image
from .blocks import Planes, in_blocks
from .numerics import at_least_float32, readable

__all__ = ["fill_missing", "filled", "finite_vectors", "grey", "may_lack_pixels", "missing", "on_photograph"]

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a grey level, kornia's ``rgb_to_grayscale``."""

_HALVINGS = 5
"""Holes of up to 2^5 px are filled from around them, larger ones in their middle with the mean of the image."""


def on_photograph(layer: Callable[[Tensor], Planes], image: Tensor, *, where_missing: float = 0.0) -> Tensor:
    """``layer`` on photographs by the one rule for what comes in.

    (B, 3, H, W) is RGB and becomes grey as :func:`grey` says. NaN and infinite pixels are missing: they are filled from
    around them before the layer, and its result there is ``where_missing``. Half types compute in float32; the result
    has the image's dtype.
    """
    check_colour_image(image)

    def on_filled(x: Tensor) -> Planes:
        if not may_lack_pixels(x):
            return layer(x)
        holes = missing(x)
        return tuple(torch.where(holes, where_missing, plane) for plane in layer(fill_missing(x, holes)))

    return in_blocks(on_filled, grey(at_least_float32(image))).to(image.dtype)


def grey(image: Tensor) -> Tensor:
    """(B, 1, H, W) of (B, 1, H, W), as it is, or of (B, 3, H, W) RGB: 0.299 R + 0.587 G + 0.114 B."""
    if image.shape[1] == 1:
        return image
    r, g, b = image.split(1, dim=1)
    level: Tensor = LUMA[0] * r + LUMA[1] * g + LUMA[2] * b
    return level


def may_lack_pixels(x: Tensor) -> bool:
    """False where a look at x, at the price of one sum, shows that it is all finite. A graph cannot look: True."""
    return not readable(x) or not math.isfinite(float(x.detach().sum()))


def missing(x: Tensor) -> Tensor:
    """Pixels that are NaN or infinite."""
    return ~(x.abs() < math.inf)


def fill_missing(x: Tensor, holes: Tensor) -> Tensor:
    """(B, C, H, W) with its holes filled: each with the mean of the smallest square of 2, 4, ... px that has any pixel.

    The squares are those of a pyramid. An image without any pixel becomes 0.
    """
    values = [torch.where(holes, 0.0, x)]
    shares = [(~holes).to(x.dtype)]
    for _ in range(_HALVINGS):
        values.append(F.avg_pool2d(values[-1], 2, ceil_mode=True))
        shares.append(F.avg_pool2d(shares[-1], 2, ceil_mode=True))
    tiny = torch.finfo(x.dtype).tiny
    fill = values[-1].sum(dim=(2, 3), keepdim=True) / shares[-1].sum(dim=(2, 3), keepdim=True).clamp(min=tiny)
    for value, share in zip(values[:0:-1], shares[:0:-1], strict=True):
        fill = torch.where(share > 0, value / share.clamp(min=tiny), fill[..., : share.shape[-2], : share.shape[-1]])
        fill = F.interpolate(fill, scale_factor=2.0, mode="nearest")
    return torch.where(holes, fill[..., : x.shape[-2], : x.shape[-1]], x)


def filled(x: Tensor) -> Tensor:
    """(B, C, H, W) with its missing pixels, if any, filled."""
    return fill_missing(x, missing(x)) if may_lack_pixels(x) else x


def finite_vectors(field: Tensor) -> Tensor:
    """(B, 2, H, W) with zero vectors in place of those that have a NaN or infinite component."""
    if not may_lack_pixels(field):
        return field
    return torch.where(missing(field).any(dim=1, keepdim=True), 0.0, field)
