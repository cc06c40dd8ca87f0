"""Bilateral and guided filters, alternatives to Perona-Malik diffusion under MCS.

Own code in place of ``kornia.filters.bilateral_blur``, which holds the whole window of every pixel in memory (289
images at sigma 4), and of ``guided_blur``, which is several times slower (``scripts/speed/filters.py`` measures both).
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from ..utils.checks import check_positive, check_tensor
from .derivatives import replicate_pad
from .inputs import fill_missing
from .learnable import check_scalar, safe_reciprocal
from .numerics import at_least_float32

__all__ = ["bilateral_smooth", "guided_smooth"]


def bilateral_smooth(image: Tensor, *, sigma: float, kappa: float | Tensor = 0.03) -> Tensor:
    r"""Bilateral filter (Tomasi and Manduchi 1998) over a square window of radius ceil(2 sigma), borders replicated.

    Args:
        image: (B, C, H, W); channels are smoothed independently. NaN pixels are missing and filled.
        sigma: spatial standard deviation in px, > 0.
        kappa: standard deviation in grey levels, > 0; a scalar tensor is differentiable.

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
    sigma, scale = check_positive(sigma, "sigma"), safe_reciprocal(check_scalar(kappa, "kappa"))
    x = fill_missing(at_least_float32(image))
    H, W = x.shape[-2:]
    radius = math.ceil(2.0 * sigma)
    padded = replicate_pad(x, radius)
    weights, total = torch.ones_like(x), x
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            if dy == dx == 0:
                continue
            neighbour = padded[..., radius + dy : radius + dy + H, radius + dx : radius + dx + W]
            log_spatial = -0.5 * (dx * dx + dy * dy) / sigma**2
            weight = torch.exp(log_spatial - 0.5 * ((neighbour - x) * scale).square())
            weights, total = weights + weight, total + weight * neighbour
    return (total / weights).to(image.dtype)


def guided_smooth(image: Tensor, *, sigma: float, kappa: float | Tensor = 0.03) -> Tensor:
    r"""Guided filter (He, Sun and Tang 2010) with the image as its own guide, borders replicated.

    The result is close to the local mean where the variance in a box is well below kappa squared, and close to the
    image where it is well above.

    Args:
        image: (B, C, H, W); channels are smoothed independently. NaN pixels are missing and filled.
        sigma: standard deviation in px of the smoothing in flat regions, > 0. It determines the radius r >= 1 of the
            box of side 2 r + 1, since two box means have the variance (2/3) r (r + 1).
        kappa: standard deviation in grey levels, > 0; a scalar tensor is differentiable.

    Returns:
        (B, C, H, W). dtype kept (half types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype or option.

    Example:
        >>> guided_smooth(torch.rand(2, 3, 16, 16), sigma=2.0).shape
        torch.Size([2, 3, 16, 16])
    """
    check_tensor(image, "image", (None, None, None, None))
    sigma, contrast = check_positive(sigma, "sigma"), 1.0 / safe_reciprocal(check_scalar(kappa, "kappa"))
    x = fill_missing(at_least_float32(image))
    radius = max(1, round((math.sqrt(6.0 * sigma**2 + 1.0) - 1.0) / 2.0))

    def box_mean(y: Tensor) -> Tensor:
        return F.avg_pool2d(replicate_pad(y, radius), 2 * radius + 1, stride=1)

    mean = box_mean(x)
    variance = (box_mean(x * x) - mean * mean).clamp(min=0.0)
    slope = variance / (variance + contrast**2)
    return (box_mean(slope) * x + box_mean(mean - slope * mean)).to(image.dtype)
