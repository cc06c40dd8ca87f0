"""Bilateral and guided filters, alternatives to Perona-Malik diffusion under MCS."""

import math

import torch.nn.functional as F
from torch import Tensor

from ..utils.checks import check_positive, check_tensor
from .derivatives import replicate_pad
from .inputs import fill_missing
from .learnable import check_scalar, safe_reciprocal
from .numerics import at_least_float32


def bilateral_smooth(image: Tensor, *, sigma: float, kappa: float | Tensor = 0.03) -> Tensor:
    r"""Bilateral filter (Tomasi and Manduchi 1998) over a square window of radius ceil(2 sigma), borders replicated.

    Args:
        image: (B, C, H, W); channels are smoothed independently. NaN pixels are missing and filled.
        sigma: spatial standard deviation in px, > 0.
        kappa: standard deviation in grey levels, > 0; a scalar tensor is differentiable.

    Returns:
        (B, C, H, W), within the range of the input.

    Example:
        >>> import torch
        >>> step = (torch.arange(16) >= 8).float().expand(1, 1, 16, 16)
        >>> torch.allclose(bilateral_smooth(step, sigma=2.0), step)
        True
    """
    check_tensor(image, "image", (None, None, None, None))
    sigma, scale = check_positive(sigma, "sigma"), 1.0 / safe_reciprocal(check_scalar(kappa, "kappa"))
    x = fill_missing(at_least_float32(image))
    if x.numel() == 0:
        return image
    side = 2 * math.ceil(2.0 * sigma) + 1
    sigma_color = scale.view(1).to(x.dtype) if isinstance(scale, Tensor) else scale
    from kornia.filters import bilateral_blur  # here, because its import takes 0.3 s

    channels = x.flatten(0, 1)[:, None]  # kornia sums differences over channels
    smoothed: Tensor = bilateral_blur(channels, (side, side), sigma_color, (sigma, sigma), border_type="replicate")
    return smoothed.view(x.shape).to(image.dtype)


def guided_smooth(image: Tensor, *, sigma: float, kappa: float | Tensor = 0.03) -> Tensor:
    r"""Guided filter (He, Sun and Tang 2010) with the image as its own guide, borders replicated.

    The result is close to the local mean where the variance in a box is well below kappa squared, and close to the
    image where it is well above.

    Args:
        image, kappa: as in :func:`bilateral_smooth`.
        sigma: standard deviation in px of the smoothing in flat regions, > 0. It determines the radius r >= 1 of the
            box of side 2 r + 1, since two box means have the variance (2/3) r (r + 1).

    Example:
        >>> import torch
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
