"""Gaussian smoothing and finite differences on (B, C, H, W) tensors, with replicated borders."""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .._checks import check_image, check_positive
from .learnable import as_number, parameter_if

__all__ = ["ImageGradient", "gaussian_smooth", "image_gradient"]


def gaussian_smooth(x: Tensor, sigma: float | Tensor) -> Tensor:
    """Separable Gaussian smoothing with replicated borders.

    Args:
        x: (B, C, H, W), any floating dtype (kept).
        sigma: standard deviation in px, >= 0; 0 returns ``x``. A scalar tensor is differentiated through; its
            support, ceil(4 sigma) px, is fixed at the time of the call.

    Example:
        >>> gaussian_smooth(torch.ones(1, 1, 5, 5), 1.0).shape
        torch.Size([1, 1, 5, 5])
    """
    value = float(sigma.detach()) if isinstance(sigma, Tensor) else sigma
    check_positive(value, "sigma", zero_ok=True)
    radius = math.ceil(4.0 * value)
    if radius == 0:
        return x
    offsets = torch.arange(-radius, radius + 1, device=x.device, dtype=x.dtype)
    kernel = torch.exp(-0.5 * (offsets / sigma) ** 2).to(x.dtype)
    kernel = kernel / kernel.sum()
    B, C, H, W = x.shape
    if torch.compiler.is_compiling() or B * C == 0:
        # Shifted sums: no group count that would tie a traced graph to one batch size.
        return _shifted_sum(_shifted_sum(x, kernel, -1), kernel, -2)
    # One group per plane: on a CPU some 25 times faster than a batch of one-channel convolutions.
    planes = replicate_pad(x, radius).reshape(1, B * C, H + 2 * radius, W + 2 * radius)
    rows = kernel.view(1, 1, 1, -1).expand(B * C, 1, -1, -1)
    with full_precision(x):
        planes = F.conv2d(planes, rows, groups=B * C)
        return F.conv2d(planes, rows.mT, groups=B * C).view(B, C, H, W)


def _shifted_sum(x: Tensor, kernel: Tensor, dim: int) -> Tensor:
    """Convolution with a symmetric odd kernel along ``dim`` (-1 or -2)."""
    radius, length = kernel.numel() // 2, x.shape[dim]
    padded = _replicate_along(x, radius, dim)
    out = padded.narrow(dim, radius, length) * kernel[radius]
    for i in range(1, radius + 1):
        pair = padded.narrow(dim, radius - i, length) + padded.narrow(dim, radius + i, length)
        out = out + pair * kernel[radius + i]
    return out


def replicate_pad(x: Tensor, radius: int) -> Tensor:
    """(B, C, H, W) with its borders repeated ``radius`` times on all four sides."""
    if torch.compiler.is_compiling():
        return _replicate_along(_replicate_along(x, radius, -1), radius, -2)
    return F.pad(x, (radius, radius, radius, radius), mode="replicate")


def _replicate_along(x: Tensor, radius: int, dim: int) -> Tensor:
    # Compiled, a concatenation is copied in vectors; F.pad becomes a gather inside every loop that reads it.
    shape = list(x.shape)
    shape[dim] = radius
    first, last = x.narrow(dim, 0, 1), x.narrow(dim, x.shape[dim] - 1, 1)
    return torch.cat([first.expand(shape), x, last.expand(shape)], dim=dim)


BLOCK = 2**20
"""Pixels that :func:`in_blocks` hands to a layer at once."""


def in_blocks(layer: Callable[..., Tensor], *tensors: Tensor | None) -> Tensor:
    """``layer(*tensors)``, on a CPU a few images at a time so that what it computes on the way stays in the cache.

    Only for layers that treat each image by itself. ``tensors`` share their first dimension; None stays None.
    """
    x = tensors[0]
    assert x is not None
    if torch.compiler.is_compiling() or x.device.type != "cpu" or x.numel() <= BLOCK:
        return layer(*tensors)
    size = max(1, BLOCK // x.shape[1:].numel())
    parts = [[None] * math.ceil(len(x) / size) if t is None else t.split(size) for t in tensors]
    return torch.cat([layer(*part) for part in zip(*parts, strict=True)])


def central_gradient(x: Tensor) -> tuple[Tensor, Tensor]:
    """(x_x, x_y) by central differences per px; one-sided halves at the border."""
    p = replicate_pad(x, 1)
    return 0.5 * (p[..., 1:-1, 2:] - p[..., 1:-1, :-2]), 0.5 * (p[..., 2:, 1:-1] - p[..., :-2, 1:-1])


def central_hessian(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(x_xx, x_yy, x_xy) by central differences per px^2."""
    p = replicate_pad(x, 1)
    xx = p[..., 1:-1, 2:] - 2.0 * x + p[..., 1:-1, :-2]
    yy = p[..., 2:, 1:-1] - 2.0 * x + p[..., :-2, 1:-1]
    xy = 0.25 * (p[..., 2:, 2:] - p[..., 2:, :-2] - p[..., :-2, 2:] + p[..., :-2, :-2])
    return xx, yy, xy


def safe_sqrt(x: Tensor) -> Tensor:
    """sqrt of max(x, 0) whose gradient is 0, not inf, where x <= 0."""
    tiny: float = torch.finfo(x.dtype).tiny
    return x.clamp(min=tiny).sqrt() - math.sqrt(tiny)


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


def image_gradient(image: Tensor, *, sigma: float | Tensor = 1.0) -> Tensor:
    """Gradient of the Gaussian-smoothed image, the paper's IG.

    Args:
        image: (B, 1, H, W) grey levels, usually in [0, 1].
        sigma: smoothing in px before differentiation, >= 0.

    Returns:
        (B, 2, H, W) grey levels per px; channel 0 = x, 1 = y. dtype kept (half types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype or sigma.

    Example:
        >>> ramp = torch.arange(8.0).expand(1, 1, 8, 8)
        >>> image_gradient(ramp, sigma=0.0)[0, :, 4, 4].tolist()
        [1.0, 0.0]
    """
    check_image(image)
    gx, gy = central_gradient(gaussian_smooth(at_least_float32(image), sigma))
    return torch.cat([gx, gy], dim=1).to(image.dtype)


class ImageGradient(nn.Module):
    """Module twin of :func:`image_gradient`; ``learnable=True`` makes sigma a parameter."""

    def __init__(self, *, sigma: float = 1.0, learnable: bool = False) -> None:
        super().__init__()
        self.sigma = parameter_if(learnable, sigma)

    def forward(self, image: Tensor) -> Tensor:
        return image_gradient(image, sigma=self.sigma)

    def extra_repr(self) -> str:
        return f"sigma={as_number(self.sigma)}"
