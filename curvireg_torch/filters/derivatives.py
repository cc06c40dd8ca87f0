"""Gaussian smoothing and finite differences on (B, C, H, W) tensors, with replicated borders."""

import itertools
import math
import mmap
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress

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
    offsets = torch.arange(-radius, radius + 1, device=like.device, dtype=like.dtype)
    weights = torch.exp(-0.5 * (offsets / sigma) ** 2).to(like.dtype) * (offsets.abs() <= torch.ceil(4.0 * sigma))
    return weights / weights.sum()


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
    if any(plane.requires_grad for plane in first):
        return torch.cat([channels(*planes) for planes in itertools.chain([first], blocks)])
    # One block in memory at a time.
    out = _empty((len(x), sum(plane.shape[1] for plane in first), *first[0].shape[2:]), first[0].dtype)
    for place, planes in zip(out.split(size), itertools.chain([first], blocks), strict=True):
        torch.cat(planes, dim=1, out=place)
    return out


def _empty(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """``torch.empty`` on the CPU. What glibc would map anew each time, in pages of 2 MB: sooner filled."""
    size = math.prod(shape) * dtype.itemsize
    if size < 2**25 or not hasattr(mmap, "MADV_HUGEPAGE"):
        return torch.empty(shape, dtype=dtype, device="cpu")
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(OSError):  # a kernel without them
        memory.madvise(mmap.MADV_HUGEPAGE)
    return torch.frombuffer(memory, dtype=dtype).view(shape)


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


def channels(*planes: Tensor) -> Tensor:
    """(B, C, H, W) of C tensors (B, 1, H, W)."""
    if len(planes) == 1:
        return planes[0]
    # Compiled, a concatenation of single channels would be laid out channels last and transposed again.
    return torch.stack([plane.squeeze(1) for plane in planes], dim=1)


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
    return in_blocks(lambda x: central_gradient(smooth(x, sigma)), at_least_float32(image)).to(image.dtype)


class ImageGradient(nn.Module):
    """Module twin of :func:`image_gradient`; ``learnable=True`` makes sigma a parameter."""

    def __init__(self, *, sigma: float = 1.0, learnable: bool = False) -> None:
        super().__init__()
        self.sigma = parameter_if(learnable, sigma)

    def forward(self, image: Tensor) -> Tensor:
        return image_gradient(image, sigma=self.sigma)

    def extra_repr(self) -> str:
        return f"sigma={as_number(self.sigma)}"
