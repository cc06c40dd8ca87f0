"""Gaussian smoothing and finite differences on (B, C, H, W) tensors, with replicated borders."""

import itertools
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
            support, ceil(4 sigma) px, is fixed at the time of the call (compiled or exported: at most 16 px).

    Example:
        >>> gaussian_smooth(torch.ones(1, 1, 5, 5), 1.0).shape
        torch.Size([1, 1, 5, 5])
    """
    return smooth(x, sigma, margin=0)


def smooth(x: Tensor, sigma: float | Tensor, *, margin: int = 1) -> Tensor:
    """:func:`gaussian_smooth` with ``margin`` px more on each side, ready for differences."""
    radius = _support(sigma)
    x = replicate_pad(x, radius + margin)
    if radius == 0:
        return x
    offsets = torch.arange(-radius, radius + 1, device=x.device, dtype=x.dtype)
    kernel = torch.exp(-0.5 * (offsets / sigma) ** 2).to(x.dtype)
    if isinstance(sigma, Tensor):
        kernel = kernel * (offsets.abs() <= torch.ceil(4.0 * sigma))
    weights = (kernel / kernel.sum()).unbind()
    # Sums of shifted images: on a CPU seldom slower than convolutions, on few images several times faster, and
    # compiled they are one loop.
    for dim in (-1, -2):
        padded, length = x, x.shape[dim] - 2 * radius
        x = padded.narrow(dim, 0, length) * weights[0]
        for i in range(1, 2 * radius + 1):
            x.addcmul_(padded.narrow(dim, i, length), weights[i])
    return x


def _support(sigma: float | Tensor) -> int:
    """Radius in px of the kernel, ceil(4 sigma); a traced graph cannot read a tensor and reserves 16 px."""
    if isinstance(sigma, Tensor):
        if torch.compiler.is_compiling():
            return 16
        sigma = float(sigma.detach())
    check_positive(sigma, "sigma", zero_ok=True)
    return math.ceil(4.0 * sigma)


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


BLOCK = 2**18
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
    blocks = (layer(*part) for part in zip(*parts, strict=True))
    if torch.is_grad_enabled():
        return torch.cat(list(blocks))
    # One block in memory at a time.
    first = next(blocks)
    out = first.new_empty(len(x), *first.shape[1:])
    for place, block in zip(out.split(size), itertools.chain([first], blocks), strict=True):
        place.copy_(block)
    return out


def central_gradient(p: Tensor) -> tuple[Tensor, Tensor]:
    """(x_x, x_y) by central differences per px of an image with a margin of 1 px."""
    return 0.5 * (p[..., 1:-1, 2:] - p[..., 1:-1, :-2]), 0.5 * (p[..., 2:, 1:-1] - p[..., :-2, 1:-1])


def central_hessian(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(x_xx, x_yy, x_xy) by central differences per px^2 of an image with a margin of 1 px."""
    x, slope = p[..., 1:-1, 1:-1], 0.5 * (p[..., 2:] - p[..., :-2])
    xx = torch.sub(p[..., 1:-1, 2:] + p[..., 1:-1, :-2], x, alpha=2)
    yy = torch.sub(p[..., 2:, 1:-1] + p[..., :-2, 1:-1], x, alpha=2)
    return xx, yy, 0.5 * (slope[..., 2:, :] - slope[..., :-2, :])


def channels(*planes: Tensor) -> Tensor:
    """(B, C, H, W) of C tensors (B, 1, H, W)."""
    # Compiled, a concatenation of single channels would be laid out channels last and transposed again.
    return torch.stack([plane.squeeze(1) for plane in planes], dim=1)


def floor(x: Tensor) -> float:
    """A positive number next to nothing in x's dtype, whose powers -1.5 (of rsqrt's derivative) are finite."""
    return math.pow(torch.finfo(x.dtype).tiny, 0.6)


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
    gx, gy = central_gradient(smooth(at_least_float32(image), sigma))
    return channels(gx, gy).to(image.dtype)


class ImageGradient(nn.Module):
    """Module twin of :func:`image_gradient`; ``learnable=True`` makes sigma a parameter."""

    def __init__(self, *, sigma: float = 1.0, learnable: bool = False) -> None:
        super().__init__()
        self.sigma = parameter_if(learnable, sigma)

    def forward(self, image: Tensor) -> Tensor:
        return image_gradient(image, sigma=self.sigma)

    def extra_repr(self) -> str:
        return f"sigma={as_number(self.sigma)}"
