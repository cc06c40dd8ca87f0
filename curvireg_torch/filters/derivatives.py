"""Gaussian smoothing and finite differences on (B, C, H, W) tensors, with replicated borders."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .._checks import check_image, check_positive

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
    value = float(sigma)
    check_positive(value, "sigma", zero_ok=True)
    radius = math.ceil(4.0 * value)
    if radius == 0:
        return x
    offsets = torch.arange(-radius, radius + 1, device=x.device, dtype=x.dtype)
    kernel = torch.exp(-0.5 * (offsets / sigma) ** 2).to(x.dtype)
    kernel = kernel / kernel.sum()
    return _convolve(_convolve(x, kernel, -1), kernel, -2)


def _convolve(x: Tensor, kernel: Tensor, dim: int) -> Tensor:
    """Convolution with a symmetric odd kernel along ``dim`` (-1 or -2)."""
    B, C, H, W = x.shape
    radius = kernel.numel() // 2
    padded = F.pad(x, (radius, radius, 0, 0) if dim == -1 else (0, 0, radius, radius), mode="replicate")
    if torch.compiler.is_compiling() or B * C == 0:
        # Shifted sums: no group count that would tie a traced graph to one batch size.
        length = x.shape[dim]
        out = padded.narrow(dim, radius, length) * kernel[radius]
        for i in range(1, radius + 1):
            pair = padded.narrow(dim, radius - i, length) + padded.narrow(dim, radius + i, length)
            out = out + pair * kernel[radius + i]
        return out
    # One group per plane: on a CPU some 25 times faster than a batch of one-channel convolutions.
    shape = (1, 1, 1, -1) if dim == -1 else (1, 1, -1, 1)
    weight = kernel.view(shape).expand(B * C, 1, -1, -1)
    return F.conv2d(padded.reshape(1, B * C, *padded.shape[-2:]), weight, groups=B * C).view(B, C, H, W)


def central_gradient(x: Tensor) -> tuple[Tensor, Tensor]:
    """(x_x, x_y) by central differences per px; one-sided halves at the border."""
    p = F.pad(x, (1, 1, 1, 1), mode="replicate")
    return 0.5 * (p[..., 1:-1, 2:] - p[..., 1:-1, :-2]), 0.5 * (p[..., 2:, 1:-1] - p[..., :-2, 1:-1])


def central_hessian(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(x_xx, x_yy, x_xy) by central differences per px^2."""
    p = F.pad(x, (1, 1, 1, 1), mode="replicate")
    xx = p[..., 1:-1, 2:] - 2.0 * x + p[..., 1:-1, :-2]
    yy = p[..., 2:, 1:-1] - 2.0 * x + p[..., :-2, 1:-1]
    xy = 0.25 * (p[..., 2:, 2:] - p[..., 2:, :-2] - p[..., :-2, 2:] + p[..., :-2, :-2])
    return xx, yy, xy


def safe_sqrt(x: Tensor) -> Tensor:
    """sqrt of max(x, 0) whose gradient is 0, not inf, where x <= 0."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, torch.ones_like(x)).sqrt(), torch.zeros_like(x))


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
    """Module twin of :func:`image_gradient`."""

    def __init__(self, *, sigma: float = 1.0) -> None:
        super().__init__()
        self.sigma = sigma

    def forward(self, image: Tensor) -> Tensor:
        return image_gradient(image, sigma=self.sigma)

    def extra_repr(self) -> str:
        return f"sigma={self.sigma}"
