"""Gaussian smoothing and finite differences on (B, C, H, W) tensors."""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from .learnable import check_width
from .numerics import at_least_float32, readable

__all__ = ["central_derivatives", "central_gradient", "extrapolate_pad", "gaussian_smooth", "replicate_pad", "smooth"]

REACH = 16
"""Largest support in px of a kernel whose sigma is a tensor: what a graph reserves that cannot read it."""

_NARROWEST = 1e-3
"""Sigma in px below which a kernel is a single 1 in every dtype, and its derivative 0."""


def gaussian_smooth(x: Tensor, sigma: float | Tensor) -> Tensor:
    """Separable Gaussian smoothing with replicated borders.

    Args:
        x: (B, C, H, W), any floating dtype (kept; half types compute in float32). NaN stays NaN and spreads.
        sigma: standard deviation in px, >= 0; 0 returns ``x``. A scalar tensor is differentiated through. The kernel is
            cut at ceil(4 sigma) px, for a tensor at 16 px at most; in a graph (compiled, exported, under vmap), where
            its sign cannot be checked, a tensor below 0.001 px counts as 0.001 px.

    Raises:
        InvalidInputError: negative, infinite or NaN sigma, or a tensor that is not a scalar.

    Example:
        >>> gaussian_smooth(torch.ones(1, 1, 5, 5), 1.0).shape
        torch.Size([1, 1, 5, 5])
    """
    return smooth(at_least_float32(x), check_width(sigma, "sigma", zero_ok=True), margin=0).to(x.dtype)


def smooth(x: Tensor, sigma: float | Tensor, *, margin: int = 1, linear: bool = False) -> Tensor:
    """:func:`gaussian_smooth` with ``margin`` px more on each side, ready for differences.

    ``linear`` goes on beyond the borders as a plane would, instead of repeating them.
    """
    radius = _support(sigma)
    x = (extrapolate_pad if linear else replicate_pad)(x, radius + margin)
    if radius == 0:
        return x
    weights = _gaussian(sigma, radius, x)
    # Sums of shifted images: on a CPU seldom slower than convolutions, on few images several times faster, and
    # compiled they are one loop.
    for dim in (-1, -2):
        padded, length = x, x.shape[dim] - 2 * radius
        x = padded.narrow(dim, 0, length) * weights[0]
        for i in range(1, 2 * radius + 1):
            part = padded.narrow(dim, i, length)
            x = x.addcmul_(part, weights[i]) if isinstance(weights, Tensor) else x.add_(part, alpha=weights[i])
    return x


def _gaussian(sigma: float | Tensor, radius: int, like: Tensor) -> Sequence[float] | Tensor:
    """2 radius + 1 weights: numbers for a number, a tensor for a tensor."""
    if not isinstance(sigma, Tensor):
        kernel = [math.exp(-0.5 * (i / sigma) ** 2) for i in range(-radius, radius + 1)]
        total = sum(kernel)
        return [weight / total for weight in kernel]
    sigma = sigma.to(like.dtype).clamp(min=_NARROWEST)
    offsets = torch.arange(-radius, radius + 1, device=like.device, dtype=like.dtype)
    weights = torch.exp(-0.5 * (offsets / sigma) ** 2) * (offsets.abs() <= torch.ceil(4.0 * sigma))
    return weights / weights.sum()


def _support(sigma: float | Tensor) -> int:
    """Radius in px of the kernel: ceil(4 sigma), or as much as holds all of a tensor's weights that are not 0."""
    if not isinstance(sigma, Tensor):
        return math.ceil(4.0 * sigma)
    return min(max(math.ceil(4.0 * float(sigma.detach())), 1), REACH) if readable(sigma) else REACH


def replicate_pad(x: Tensor, radius: int) -> Tensor:
    """(B, C, H, W) with its borders repeated ``radius`` times on all four sides."""
    if not torch.compiler.is_compiling():
        return F.pad(x, (radius, radius, radius, radius), mode="replicate") if radius else x
    # Compiled, a concatenation is copied in vectors; F.pad becomes a gather inside every loop that reads it.
    for dim in (-1, -2):
        shape = list(x.shape)
        shape[dim] = radius
        first, last = x.narrow(dim, 0, 1), x.narrow(dim, x.shape[dim] - 1, 1)
        x = torch.cat([first.expand(shape), x, last.expand(shape)], dim=dim)
    return x


def extrapolate_pad(x: Tensor, radius: int) -> Tensor:
    """(B, C, H, W) continued by ``radius`` px on all sides with the slope at its borders: planes stay planes."""
    steps = torch.arange(1, radius + 1, device=x.device, dtype=x.dtype)
    for dim in (-1, -2):
        n, k = x.shape[dim], steps if dim == -1 else steps[:, None]
        first, last = x.narrow(dim, 0, 1), x.narrow(dim, n - 1, 1)
        # An image one pixel wide has no slope.
        fall, rise = first - x.narrow(dim, min(1, n - 1), 1), last - x.narrow(dim, max(n - 2, 0), 1)
        x = torch.cat([first + fall * k.flip(0), x, last + rise * k], dim=dim)
    return x


def central_gradient(p: Tensor) -> tuple[Tensor, Tensor]:
    """(x_x, x_y) by central differences per px of an image with a margin of 1 px."""
    return _half(p[..., 1:-1, 2:], p[..., 1:-1, :-2]), _half(p[..., 2:, 1:-1], p[..., :-2, 1:-1])


def central_derivatives(p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """(x_x, x_y, x_xx, x_yy, x_xy) by central differences per px and px^2 of an image with a margin of 1 px."""
    x, slope = p[..., 1:-1, 1:-1], _half(p[..., 2:], p[..., :-2])
    xx = (p[..., 1:-1, 2:] + p[..., 1:-1, :-2]).sub_(x, alpha=2)
    yy = (p[..., 2:, 1:-1] + p[..., :-2, 1:-1]).sub_(x, alpha=2)
    xy = _half(slope[..., 2:, :], slope[..., :-2, :])
    return slope[..., 1:-1, :], _half(p[..., 2:, 1:-1], p[..., :-2, 1:-1]), xx, yy, xy


def _half(after: Tensor, before: Tensor) -> Tensor:
    return torch.sub(after, before).mul_(0.5)
