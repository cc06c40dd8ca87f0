"""Bilateral and guided filters: smoothings that could replace Perona-Malik under MCS."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from ..utils.checks import check_positive, check_tensor
from .derivatives import replicate_pad
from .inputs import filled
from .learnable import check_width, inverse
from .numerics import at_least_float32

__all__ = ["bilateral_smooth", "guided_smooth"]


def bilateral_smooth(image: Tensor, *, sigma: float, kappa: float | Tensor = 0.03) -> Tensor:
    r"""Bilateral filter (Tomasi and Manduchi 1998) over the square of 2 sigma around each pixel, borders replicated.

    One shift of the image per pixel of the window: the memory of a few images, where unfolding (kornia's
    ``bilateral_blur``) holds the whole window of every pixel.

    Args:
        image: (B, C, H, W); channels are smoothed independently. NaN pixels are missing and come out filled.
        sigma: spatial standard deviation in px, > 0.
        kappa: standard deviation in grey levels, > 0; a scalar tensor is differentiated through.

    Returns:
        (B, C, H, W), within the range of the input. dtype kept (half types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype or option.

    Example:
        >>> step = (torch.arange(16) >= 8).float().expand(1, 1, 16, 16)
        >>> torch.allclose(bilateral_smooth(step, sigma=2.0), step)
        True
    """
    check_tensor(image, "image", (None, None, None, None))
    width, sharpness = check_positive(sigma, "sigma"), inverse(check_width(kappa, "kappa"))
    x = filled(at_least_float32(image))
    H, W = x.shape[-2:]
    radius = math.ceil(2.0 * width)
    padded = replicate_pad(x, radius)
    weights, total = torch.ones_like(x), x
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            if dy == dx == 0:
                continue
            neighbour = padded[..., radius + dy : radius + dy + H, radius + dx : radius + dx + W]
            nearness = -0.5 * (dx * dx + dy * dy) / width**2
            weight = torch.exp(nearness - 0.5 * ((neighbour - x) * sharpness).square())
            weights, total = weights + weight, total + weight * neighbour
    return (total / weights).to(image.dtype)


def guided_smooth(image: Tensor, *, sigma: float, kappa: float | Tensor = 0.03) -> Tensor:
    r"""Guided filter (He, Sun and Tang 2010) with the image as its own guide, borders replicated.

    Where the variance in a box is well below kappa squared the result is the mean, where it is well above, the image.

    Args:
        image: (B, C, H, W); channels are smoothed independently. NaN pixels are missing and come out filled.
        sigma: standard deviation in px of the smoothing on flat ground, > 0. Two means over boxes of side 2 r + 1
            follow each other; r is the whole number nearest to that variance, at least 1.
        kappa: standard deviation in grey levels, > 0; a scalar tensor is differentiated through.

    Returns:
        (B, C, H, W). dtype kept (half types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype or option.

    Example:
        >>> guided_smooth(torch.rand(2, 3, 16, 16), sigma=2.0).shape
        torch.Size([2, 3, 16, 16])
    """
    check_tensor(image, "image", (None, None, None, None))
    width, contrast = check_positive(sigma, "sigma"), 1.0 / inverse(check_width(kappa, "kappa"))
    x = filled(at_least_float32(image))
    radius = max(1, round((math.sqrt(6.0 * width**2 + 1.0) - 1.0) / 2.0))

    def mean(y: Tensor) -> Tensor:
        return F.avg_pool2d(replicate_pad(y, radius), 2 * radius + 1, stride=1)

    average = mean(x)
    variance = (mean(x * x) - average * average).clamp(min=0.0)
    slope = variance / (variance + contrast**2)
    return (mean(slope) * x + mean(average - slope * average)).to(image.dtype)
