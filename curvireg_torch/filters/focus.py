"""Edge blur from re-blurring ratios, and multi-scale focus curves (MFC) of photographs."""

import functools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_integer, check_option, check_positive
from . import operations as ops
from .curvilinear import scaled_direction
from .modules import FunctionModule

MODES = ("reblur-image", "reblur-saliency")
MAX_BLUR = 1000.0  # px, reported where re-blurring does not lower the saliency
MIN_BLUR = 0.6  # px, about that of the derivative kernel: MFC does not tell sharper edges apart
# of CS, relative to the largest in the image; chosen on 1008 generated photographs (docs/paper.md)
THRESHOLD = 0.03
PAPER_THRESHOLD = math.exp(-5)  # T = e^-n of the paper, n = 5 scales, as of MCS


def edge_blur(
    image: Tensor,
    *,
    reblur_sigmas: Sequence[float] = (1.0, 2.0, 3.0, 4.0),
    mode: str = "reblur-image",
) -> Tensor:
    r"""Blur (standard deviation in px) of the step edge through each pixel, one estimate per
    re-blurring.

    With :math:`R_i = CS / CS_i` at the edge, where CS is :math:`|\nabla I|^2`:

    - ``"reblur-image"``: :math:`CS_i = |\nabla(I * g_i)|^2`, :math:`R_i = 1 + \sigma_i^2/\sigma^2`,
      so :math:`s_i = \sigma_i/\sqrt{R_i-1}`;
    - ``"reblur-saliency"`` (the paper's ``CSmultiscale`` as printed): :math:`CS_i = CS * g_i`,
      :math:`R_i = \sqrt{1+2\sigma_i^2/\sigma^2}`, so
      :math:`s_i = \sqrt 2\,\sigma_i/\sqrt{R_i^2-1}`.

    (The paper prints :math:`R_i = CS_i/CS`, which is below 1 on an edge.) The blur of the
    derivative kernel, which depends on the direction of the edge, is subtracted. On the centre line
    of a step edge of 1 to 4 px in any direction the estimate is accurate to 1.5 %; it grows beside
    it.

    Args:
        image: (B, 1, H, W) grey levels, or (B, 3, H, W) RGB. Missing (NaN) pixels give 1000.
        reblur_sigmas: S re-blurring sigmas in px, > 0.
        mode: ``"reblur-image"`` or ``"reblur-saliency"``.

    Returns:
        (B, S, H, W) blur in px, in [0, 1000]; 1000 where re-blurring does not lower the saliency.

    Example:
        >>> x = torch.arange(65.0) - 32
        >>> edge = (0.5 + 0.5 * torch.erf(x / (2.0 * 2**0.5))).expand(1, 1, 65, 65)     # sigma 2 px
        >>> abs(float(edge_blur(edge)[0, 0, 32, 32]) - 2.0) < 0.06
        True
    """
    check_option(mode, MODES, "mode")
    sigmas = ops.check_sigmas(reblur_sigmas, "reblur_sigmas")

    def layer(x: Tensor, missing: Tensor | None) -> ops.Planes:
        gx, gy = ops.central_gradient(ops.smooth(x, 0.0))
        return tuple(_edge_blur(x, gx, gy, sigmas, mode, missing))

    return ops.apply_to_photograph(layer, image, missing_value=MAX_BLUR)


def _edge_blur(
    x: Tensor,
    gx: Tensor,
    gy: Tensor,
    reblur_sigmas: Sequence[float],
    mode: str,
    missing: Tensor | None,
) -> list[Tensor]:
    """Blur of the edge through each pixel of ``x``, whose gradient is (gx, gy), for each
    re-blurring."""
    x = ops.replicate_box(x, missing)
    saliency = ops.replicate_box(ops.squared_length(gx, gy), missing)
    # 1 and 0 instead of tiny numbers, whose quotients have no finite second derivative
    flat = saliency <= ops.safe_eps(saliency)
    variance, fourth = _difference_moments(gx, torch.where(flat, 1.0, saliency))
    blurs = []
    for sigma in reblur_sigmas:
        if mode == "reblur-image":
            rx, ry = ops.central_gradient(ops.smooth(x, sigma))
            reblurred = ops.squared_length(rx, ry)
            # sigma_i^2 / (R - 1) with R = saliency / reblurred, without dividing by zero.
            numerator = sigma**2 * reblurred
            denominator = saliency - reblurred
        else:
            reblurred = ops.smooth(saliency, sigma, margin=0)
            numerator = 2.0 * sigma**2 * reblurred.square()
            denominator = saliency.square() - reblurred.square()
        numerator = torch.where(flat, 1.0, numerator + ops.safe_eps(numerator))
        denominator = torch.where(flat, 0.0, denominator)
        quotient = numerator / torch.maximum(denominator, numerator / (MAX_BLUR**2 + variance))
        measured = torch.maximum(quotient, variance)
        remainder = fourth * (measured.reciprocal() + (measured + sigma**2).reciprocal())
        blurs.append(ops.safe_sqrt(measured - variance - remainder))
    return blurs


def _difference_moments(gx: Tensor, saliency: Tensor) -> tuple[Tensor, Tensor]:
    r"""What central differences add to the squared blur of an edge with the gradient g.

    By the series of erf, an edge of blur s has :math:`CS \propto 1/(s^2 + v + e/s^2)` up to the
    order of 1/s^6, with the variance :math:`v = \frac13 (g_x^4 + g_y^4)/|g|^4` and
    :math:`e = v^2 - \frac7{90}(g_x^6 + g_y^6)/|g|^6`. Returns v in px^2 and e in px^4. The
    ``saliency`` is positive.
    """
    along_x = gx * gx / saliency
    product = along_x * (1.0 - along_x)  # g_x^2 g_y^2 / |g|^4
    variance = (1.0 - 2.0 * product) / 3.0
    fourth = variance.square() - (7.0 / 90.0) * (1.0 - 3.0 * product)
    return variance, fourth


def multiscale_focus_curves(
    image: Tensor,
    *,
    scales: int = 5,
    sigma: float | Tensor = 1.0,
    mode: str = "reblur-image",
    saliency_weight: float = 1.0,
    threshold: float = THRESHOLD,
) -> Tensor:
    r"""MFC (the paper's section "Multi Focus Curves"): edges in focus, the sharpest with the
    largest length.

    The image is re-blurred by 1, 2, ..., n-1 px. A pixel is retained where its focus :math:`1/s_i`
    exceeds :math:`e^{-n}` at all n-1 scales and its saliency exceeds ``threshold``, which rejects
    noise in flat regions: noise is in focus. Its value is :math:`1/\max_i s_i` (the paper's
    ``ratiogradientMerge``, where arg is a misprint): at most 1/s at step edges of any direction (to
    0.5 %), where :math:`s^2` is their squared blur plus ``sigma`` squared, and 1/0.6 per px
    elsewhere.

    Args:
        image: (B, 1, H, W) grey levels in [0, 1], or (B, 3, H, W) RGB. Missing (NaN) pixels give 0.
        scales: n >= 2.
        sigma: smoothing in px before all other steps, >= 0.
        mode: of :func:`edge_blur`.
        saliency_weight: p >= 0; the focus is multiplied by :math:`CS^p`. 1 ranks the views of real
            photographs best.
        threshold: least saliency CS of an edge, as a fraction in [0, 1) of the largest in the
            image. CS is a square: of .01, edges of a tenth of the strongest gradient remain. The
            paper chooses it as for MCS, :math:`e^{-5}`.

    Returns:
        (B, 2, H, W) focus in 1/px, times CS^p in (grey levels per px)^2p, along the gradient.

    Example:
        >>> multiscale_focus_curves(torch.rand(2, 1, 32, 32)).shape
        torch.Size([2, 2, 32, 32])
    """
    check_option(mode, MODES, "mode")
    check_integer(scales, "scales", least=2)
    power = check_positive(saliency_weight, "saliency_weight", zero_ok=True)
    checked_sigma = ops.check_scalar(sigma, "sigma", zero_ok=True)
    least = check_positive(threshold, "threshold", zero_ok=True)
    if least >= 1.0:
        raise InvalidInputError(f"threshold: expected 0 <= threshold < 1, got {least}")

    def layer(image: Tensor, missing: Tensor | None) -> ops.Planes:
        x = ops.smooth(image, checked_sigma)
        gx, gy = ops.central_gradient(x)
        saliency = ops.squared_length(gx, gy)
        reblur_sigmas = [float(i) for i in range(1, scales)]
        blurs = _edge_blur(x[..., 1:-1, 1:-1], gx, gy, reblur_sigmas, mode, missing)
        blur = functools.reduce(torch.maximum, blurs)
        focus = blur.clamp(min=MIN_BLUR).reciprocal()
        limit = least * ops.image_maximum(saliency, missing)
        retained = (focus > math.exp(-scales)) & (saliency > limit)
        weight = saliency.clamp(min=ops.safe_eps(saliency)) ** power
        return scaled_direction(focus * weight * retained, gx, gy)

    return ops.apply_to_photograph(layer, image)


class EdgeBlur(FunctionModule, function=edge_blur):
    """Module twin of :func:`edge_blur`."""

    def __init__(
        self, *, reblur_sigmas: Sequence[float] = (1.0, 2.0, 3.0, 4.0), mode: str = "reblur-image"
    ) -> None: ...


class MultiScaleFocusCurves(FunctionModule, function=multiscale_focus_curves, learnable=("sigma",)):
    """Module twin of :func:`multiscale_focus_curves`."""

    def __init__(
        self,
        *,
        scales: int = 5,
        sigma: float = 1.0,
        mode: str = "reblur-image",
        saliency_weight: float = 1.0,
        threshold: float = THRESHOLD,
        learnable: bool = False,
    ) -> None: ...
