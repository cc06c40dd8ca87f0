"""Gaussian smoothing and finite differences on (B, C, H, W) tensors."""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from .learnable import check_scalar
from .numerics import at_least_float32, is_host_readable

_MAX_TENSOR_RADIUS = 16
"""Largest kernel radius in px for a sigma that is a tensor: a traced graph reserves it, since it cannot read sigma."""

_MIN_SIGMA = 1e-3
"""Sigma in px below which a kernel is a single 1 in every dtype and has derivative 0."""


def gaussian_smooth(x: Tensor, sigma: float | Tensor) -> Tensor:
    """Separable Gaussian smoothing with replicated borders.

    Args:
        x: (B, C, H, W), as the result. NaN spreads.
        sigma: standard deviation in px, >= 0; 0 returns ``x``. A scalar tensor is differentiable. The kernel is cut at
            ceil(4 sigma) px, for a tensor at 16 px at most. While tracing (compile, export, vmap), the sign of a tensor
            cannot be checked, and values below 0.001 px are clamped to 0.001 px.

    Example:
        >>> gaussian_smooth(torch.ones(1, 1, 5, 5), 1.0).shape
        torch.Size([1, 1, 5, 5])
    """
    return smooth(at_least_float32(x), check_scalar(sigma, "sigma", zero_ok=True), margin=0).to(x.dtype)


def smooth(x: Tensor, sigma: float | Tensor, *, margin: int = 1, linear: bool = False) -> Tensor:
    """:func:`gaussian_smooth` of an image enlarged by ``margin`` px on each side, as finite differences need it.

    ``linear`` extrapolates beyond the borders with the slope there instead of replicating them.
    """
    radius = _kernel_radius(sigma)
    x = (extrapolate_pad if linear else replicate_pad)(x, radius + margin)
    if radius == 0:
        return x
    weights = _gaussian_kernel(sigma, radius, x)
    # Sums of shifted images: on a CPU seldom slower than a convolution, much faster on few images, one loop when
    # compiled.
    for dim in (-1, -2):
        padded, length = x, x.shape[dim] - 2 * radius
        x = padded.narrow(dim, 0, length) * weights[0]
        for i in range(1, 2 * radius + 1):
            part = padded.narrow(dim, i, length)
            x = x.addcmul_(part, weights[i]) if isinstance(weights, Tensor) else x.add_(part, alpha=weights[i])
    return x


def _gaussian_kernel(sigma: float | Tensor, radius: int, like: Tensor) -> Sequence[float] | Tensor:
    """2 radius + 1 weights: floats for a float, a tensor for a tensor."""
    if not isinstance(sigma, Tensor):
        kernel = [math.exp(-0.5 * (i / sigma) ** 2) for i in range(-radius, radius + 1)]
        total = sum(kernel)
        return [weight / total for weight in kernel]
    sigma = sigma.to(like.dtype).clamp(min=_MIN_SIGMA)
    offsets = torch.arange(-radius, radius + 1, device=like.device, dtype=like.dtype)
    weights = torch.exp(-0.5 * (offsets / sigma) ** 2) * (offsets.abs() <= torch.ceil(4.0 * sigma))
    return weights / weights.sum()


def _kernel_radius(sigma: float | Tensor) -> int:
    if not isinstance(sigma, Tensor):
        return math.ceil(4.0 * sigma)
    if not is_host_readable(sigma):
        return _MAX_TENSOR_RADIUS
    return min(max(math.ceil(4.0 * float(sigma.detach())), 1), _MAX_TENSOR_RADIUS)


def replicate_pad(x: Tensor, radius: int) -> Tensor:
    """Pad (B, C, H, W) by ``radius`` px on all sides with the nearest border pixel."""
    if not torch.compiler.is_compiling():
        return F.pad(x, (radius, radius, radius, radius), mode="replicate") if radius else x
    # Compiled, a concatenation is a vectorised copy; F.pad becomes a gather inside every loop that reads it.
    for dim in (-1, -2):
        shape = list(x.shape)
        shape[dim] = radius
        first, last = x.narrow(dim, 0, 1), x.narrow(dim, x.shape[dim] - 1, 1)
        x = torch.cat([first.expand(shape), x, last.expand(shape)], dim=dim)
    return x


def extrapolate_pad(x: Tensor, radius: int) -> Tensor:
    """Pad (B, C, H, W) by ``radius`` px on all sides with the slope at the border, so that planes stay planes."""
    steps = torch.arange(1, radius + 1, device=x.device, dtype=x.dtype)
    for dim in (-1, -2):
        n, k = x.shape[dim], steps if dim == -1 else steps[:, None]
        first, last = x.narrow(dim, 0, 1), x.narrow(dim, n - 1, 1)
        # The indices are clamped because an image one pixel wide has no slope.
        fall, rise = first - x.narrow(dim, min(1, n - 1), 1), last - x.narrow(dim, max(n - 2, 0), 1)
        x = torch.cat([first + fall * k.flip(0), x, last + rise * k], dim=dim)
    return x


def central_gradient(p: Tensor) -> tuple[Tensor, Tensor]:
    """(p_x, p_y) per px by central differences; the result is 1 px smaller than p on each side."""
    return _half_difference(p[..., 1:-1, 2:], p[..., 1:-1, :-2]), _half_difference(p[..., 2:, 1:-1], p[..., :-2, 1:-1])


def central_derivatives(p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """(p_x, p_y, p_xx, p_yy, p_xy) per px and px^2; each is 1 px smaller than p on each side."""
    x, slope = p[..., 1:-1, 1:-1], _half_difference(p[..., 2:], p[..., :-2])
    xx = (p[..., 1:-1, 2:] + p[..., 1:-1, :-2]).sub_(x, alpha=2)
    yy = (p[..., 2:, 1:-1] + p[..., :-2, 1:-1]).sub_(x, alpha=2)
    xy = _half_difference(slope[..., 2:, :], slope[..., :-2, :])
    return slope[..., 1:-1, :], _half_difference(p[..., 2:, 1:-1], p[..., :-2, 1:-1]), xx, yy, xy


def _half_difference(after: Tensor, before: Tensor) -> Tensor:
    return torch.sub(after, before).mul_(0.5)
