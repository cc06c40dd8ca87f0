"""Edge blur from re-blurring ratios, and multi-scale focus curves (MFC) of photographs."""

import functools
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_option, check_positive
from .blocks import Planes
from .curvilinear import along
from .derivatives import central_gradient, smooth
from .inputs import on_photograph
from .learnable import as_number, check_width, keep_positive, positive_option
from .numerics import floor, image_maximum, safe_sqrt, squared_length

__all__ = ["EdgeBlur", "MultiScaleFocusCurves", "edge_blur", "multiscale_focus_curves"]

MODES = ("reblur-image", "reblur-saliency")
MAX_BLUR = 1000.0
"""Blur in px reported where re-blurring changes nothing (no edge, or infinitely smooth)."""

_DIFFERENCE_VARIANCE = 0.36
"""Variance in px^2 that the 3-tap central difference itself adds to an edge: its second moment is 1/3, but it is not a
Gaussian, and 0.36 lowers the largest error at blurs of 1 to 4 px from 3.1 to 1.8 %."""

_EDGE_FLOOR = 1e-3
"""CS below this share of the image's largest CS is not an edge (noise is infinitely sharp); about 3 % of the
contrast."""


def edge_blur(
    image: Tensor,
    *,
    reblur_sigmas: Sequence[float] = (1.0, 2.0, 3.0, 4.0),
    mode: str = "reblur-image",
) -> Tensor:
    r"""Blur (standard deviation, px) of the step edge through each pixel, one estimate per re-blurring.

    With :math:`R_i = CS / CS_i` at the edge, where CS is :math:`|\nabla I|^2`:

    - ``"reblur-image"``: :math:`CS_i = |\nabla(I * g_i)|^2`, :math:`R_i = 1 + \sigma_i^2/\sigma^2`, so
      :math:`s_i = \sigma_i/\sqrt{R_i-1}`;
    - ``"reblur-saliency"`` (the letter of the paper's ``CSmultiscale``): :math:`CS_i = CS * g_i`,
      :math:`R_i = \sqrt{1+2\sigma_i^2/\sigma^2}`, so :math:`s_i = \sqrt 2\,\sigma_i/\sqrt{R_i^2-1}`.

    (The paper writes :math:`R_i = CS_i/CS`, which is below 1 on an edge.) The blur of the derivative kernel is
    subtracted. The estimate is right on the edge's centre line; beside it :math:`R_i` falls and the blur grows.

    Args:
        image: (B, 1, H, W) grey levels, or (B, 3, H, W) RGB; NaN pixels are missing (1000 in the result).
        reblur_sigmas: S re-blurring sigmas in px, > 0.
        mode: ``"reblur-image"`` or ``"reblur-saliency"``.

    Returns:
        (B, S, H, W) blur in px, in [0, 1000]; 1000 where re-blurring does not lower the saliency. dtype kept (half
        types compute in float32).

    Raises:
        InvalidInputError: wrong shape, dtype or option.

    Example:
        >>> x = torch.arange(65.0) - 32
        >>> edge = (0.5 + 0.5 * torch.erf(x / (2.0 * 2**0.5))).expand(1, 1, 65, 65)     # sigma 2 px
        >>> abs(float(edge_blur(edge)[0, 0, 32, 32]) - 2.0) < 0.06
        True
    """
    widths = _check_reblurring(reblur_sigmas, mode)

    def layer(x: Tensor) -> Planes:
        gx, gy = central_gradient(smooth(x, 0.0))
        return tuple(_edge_blur(x, squared_length(gx, gy), widths, mode))

    return on_photograph(layer, image, where_missing=MAX_BLUR)


def _check_reblurring(reblur_sigmas: Sequence[float], mode: str) -> list[float]:
    check_option(mode, MODES, "mode")
    if len(reblur_sigmas) == 0:
        raise InvalidInputError("reblur_sigmas: expected at least one sigma, got none")
    return [check_positive(float(sigma), "reblur_sigmas") for sigma in reblur_sigmas]


def _edge_blur(x: Tensor, saliency: Tensor, reblur_sigmas: Sequence[float], mode: str) -> list[Tensor]:
    blurs: list[Tensor] = []
    for sigma in reblur_sigmas:
        if mode == "reblur-image":
            rx, ry = central_gradient(smooth(x, sigma))
            reblurred = squared_length(rx, ry)
            # sigma_i^2 / (R - 1) with R = saliency / reblurred, without dividing by zero.
            numerator, denominator = sigma**2 * reblurred, saliency - reblurred
        else:
            reblurred = smooth(saliency, sigma, margin=0)
            numerator, denominator = 2.0 * sigma**2 * reblurred.square(), saliency.square() - reblurred.square()
        numerator = numerator + floor(numerator)
        quotient = numerator / torch.maximum(denominator, numerator / (MAX_BLUR**2 + _DIFFERENCE_VARIANCE))
        blurs.append(safe_sqrt(quotient - _DIFFERENCE_VARIANCE))
    return blurs


def multiscale_focus_curves(
    image: Tensor,
    *,
    scales: int = 5,
    sigma: float | Tensor = 1.0,
    mode: str = "reblur-image",
    saliency_weight: float = 1.0,
    threshold: float | None = None,
) -> Tensor:
    r"""MFC: edges in focus (the paper's section "Multi Focus Curves"), with the sharpest edges longest.

    The image is re-blurred by 1, 2, ..., n-1 px. A pixel is kept where its focus :math:`1/s_i` exceeds T at all n-1
    scales and its saliency exceeds 0.1 % of the image's largest (flat noise is infinitely sharp). Its value is
    :math:`1/\max_i s_i` (the paper's ``ratiogradientMerge``, whose arg is a slip). The measured blur of a step edge
    includes the pre-smoothing ``sigma``, so that its value is at most 1/sigma. Noise, thin lines and corners are not
    step edges: their value is limited at every sigma by the derivative kernel alone, to 1/0.6 = 1.67 per px.

    Args:
        image: (B, 1, H, W) grey levels in [0, 1], or (B, 3, H, W) RGB; NaN pixels are missing (0 in the result).
        scales: n >= 2.
        sigma: smoothing in px before everything else.
        mode: of :func:`edge_blur`.
        saliency_weight: p >= 0: the focus is multiplied by :math:`CS^p`. 0 is the focus alone, 0.5 multiplies by
            :math:`|\nabla I|`; 1 ranks the views of real photographs best.
        threshold: T >= 0 in 1/px; None is the paper's :math:`e^{-n}`.

    Returns:
        (B, 2, H, W) focus in 1/px, times CS^p in (grey levels per px)^2p, along the gradient. dtype kept.

    Raises:
        InvalidInputError: wrong shape, dtype or option.

    Example:
        >>> multiscale_focus_curves(torch.rand(2, 1, 32, 32)).shape
        torch.Size([2, 2, 32, 32])
    """
    power, limit = _check_focus(scales, mode, saliency_weight, threshold)
    width = check_width(sigma, "sigma", zero_ok=True)

    def layer(image: Tensor) -> Planes:
        x = smooth(image, width)
        gx, gy = central_gradient(x)
        x = x[..., 1:-1, 1:-1]
        saliency = squared_length(gx, gy)
        blur = functools.reduce(torch.maximum, _edge_blur(x, saliency, [float(i) for i in range(1, scales)], mode))
        # Sub-pixel blur is not measurable: it counts as the derivative kernel's own.
        focus = blur.clamp(min=_DIFFERENCE_VARIANCE**0.5).reciprocal()
        kept = (focus > limit) & (saliency > _EDGE_FLOOR * image_maximum(saliency))
        weight = saliency.clamp(min=floor(saliency)) ** power
        return along(focus * weight * kept, gx, gy)

    return on_photograph(layer, image)


def _check_focus(scales: int, mode: str, saliency_weight: float, threshold: float | None) -> tuple[float, float]:
    """p and T."""
    check_option(mode, MODES, "mode")
    if scales < 2:
        raise InvalidInputError(f"scales: expected >= 2, got {scales}")
    limit = math.exp(-scales) if threshold is None else check_positive(threshold, "threshold", zero_ok=True)
    return check_positive(saliency_weight, "saliency_weight", zero_ok=True), limit


class EdgeBlur(nn.Module):
    """Blur of the step edge through each pixel, as a layer; module twin of :func:`edge_blur`.

    Args:
        reblur_sigmas: S re-blurring sigmas in px, > 0.
        mode: ``"reblur-image"`` or ``"reblur-saliency"``.

    Shape:
        Input (B, 1, H, W) grey levels or (B, 3, H, W) RGB; output (B, S, H, W) in px.

    Example:
        >>> import torch
        >>> EdgeBlur(reblur_sigmas=(1.0, 2.0))(torch.rand(1, 1, 32, 32)).shape
        torch.Size([1, 2, 32, 32])
    """

    def __init__(self, *, reblur_sigmas: Sequence[float] = (1.0, 2.0, 3.0, 4.0), mode: str = "reblur-image") -> None:
        super().__init__()
        _check_reblurring(reblur_sigmas, mode)
        self.reblur_sigmas, self.mode = tuple(reblur_sigmas), mode

    def forward(self, image: Tensor) -> Tensor:
        return edge_blur(image, reblur_sigmas=self.reblur_sigmas, mode=self.mode)

    def extra_repr(self) -> str:
        return f"reblur_sigmas={self.reblur_sigmas}, mode={self.mode!r}"


class MultiScaleFocusCurves(nn.Module):
    """MFC, as a layer; module twin of :func:`multiscale_focus_curves`.

    Args:
        scales: n >= 2; the image is re-blurred by 1, 2, ..., n-1 px.
        sigma: smoothing in px before everything else, >= 0.
        mode: of :func:`edge_blur`.
        saliency_weight: p >= 0: the focus is multiplied by CS^p.
        threshold: T >= 0 in 1/px; None is e^-n.
        learnable: make the logarithm of sigma a parameter, ``log_sigma``; then sigma > 0.

    Shape:
        Input (B, 1, H, W) grey levels or (B, 3, H, W) RGB; output (B, 2, H, W).

    Example:
        >>> import torch
        >>> from curvireg_torch import HOG
        >>> torch.nn.Sequential(MultiScaleFocusCurves(), HOG())(torch.rand(2, 3, 64, 64)).shape
        torch.Size([2, 1764])
    """

    sigma = positive_option("sigma")

    def __init__(
        self,
        *,
        scales: int = 5,
        sigma: float = 1.0,
        mode: str = "reblur-image",
        saliency_weight: float = 1.0,
        threshold: float | None = None,
        learnable: bool = False,
    ) -> None:
        super().__init__()
        _check_focus(scales, mode, saliency_weight, threshold)
        check_width(sigma, "sigma", zero_ok=True)
        keep_positive(self, learnable, sigma=sigma)
        self.scales, self.mode = scales, mode
        self.saliency_weight, self.threshold = saliency_weight, threshold

    def forward(self, image: Tensor) -> Tensor:
        return multiscale_focus_curves(
            image,
            scales=self.scales,
            sigma=self.sigma,
            mode=self.mode,
            saliency_weight=self.saliency_weight,
            threshold=self.threshold,
        )

    def extra_repr(self) -> str:
        return (
            f"scales={self.scales}, sigma={as_number(self.sigma)}, mode={self.mode!r}, "
            f"saliency_weight={self.saliency_weight}, threshold={self.threshold}"
        )
