"""Multi-scale curvilinear saliency (MCS) of photographs over an edge-preserving scale space."""

import math

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_option, check_positive
from .blocks import Planes, stack_channels
from .curvilinear import scaled_direction
from .derivatives import central_gradient, smooth
from .diffusion import CONDUCTANCES, diffuse
from .edge_preserving import bilateral_smooth, guided_smooth
from .inputs import apply_to_photograph
from .learnable import OptionsModule, check_scalar
from .numerics import image_maximum, squared_length

SMOOTHINGS = ("perona-malik", "bilateral", "guided")

_STEP = 0.2
"""Time step of the diffusion."""


def multiscale_curvilinear_saliency(
    image: Tensor,
    *,
    scales: int = 5,
    sigma: float | Tensor = 1.0,
    smoothing: str = "perona-malik",
    kappa: float | Tensor = 0.03,
    conductance: str = "rational",
    diffusion_time: float | None = None,
    threshold: float | None = None,
) -> Tensor:
    r"""MCS (the paper's section "Multi-Curvilinear Saliency"): edges that survive edge-preserving smoothing.

    The image curvilinear saliency :math:`|\nabla I|^2` of every level is divided by its maximum over the image. The
    result is the largest of these where *every* level exceeds T, and 0 elsewhere.

    Args:
        image: (B, 1, H, W) grey levels in [0, 1], or (B, 3, H, W) RGB. Missing (NaN) pixels give 0.
        scales: number n of levels, the image included; each has twice the diffusion time t of the previous one.
        sigma: smoothing in px before differentiation, >= 0.
        smoothing: ``"perona-malik"`` (:func:`anisotropic_diffusion` to time t), or ``"bilateral"`` or ``"guided"``
            with the width of linear diffusion to time t, sqrt(2 t) px.
        kappa: contrast in grey levels above which an edge is preserved, > 0, for all smoothings.
        conductance: of :func:`anisotropic_diffusion`.
        diffusion_time: t of the last level in px^2; None is 2^(n-2), that is 0, 5, 10, 20, ... steps of 0.2.
        threshold: T in [0, 1); None is the paper's :math:`e^{-n}`.

    Returns:
        (B, 2, H, W): length in [0, 1], direction of the gradient at the level with the largest value.

    Example:
        >>> step = (torch.arange(32) >= 16).float().expand(1, 1, 32, 32)
        >>> field = multiscale_curvilinear_saliency(step)
        >>> round(float(field[0, :, 16, 16].norm()), 3)
        1.0
    """
    times, limit = _check_scales(scales, smoothing, conductance, diffusion_time, threshold)
    checked_sigma, contrast = check_scalar(sigma, "sigma", zero_ok=True), check_scalar(kappa, "kappa")

    def layer(image: Tensor) -> Planes:
        level, steps_done = image, 0
        field, saliency = _normalised_saliency(level, checked_sigma)
        lowest = saliency
        for time in times:
            if smoothing == "perona-malik":
                steps = max(round(time / _STEP), 1)
                level = diffuse(level, max(steps - steps_done, 0), contrast, _STEP, conductance)
                steps_done = max(steps, steps_done)
            else:
                edge_preserving = bilateral_smooth if smoothing == "bilateral" else guided_smooth
                level = edge_preserving(image, sigma=math.sqrt(2.0 * time), kappa=contrast)
            level_field, level_saliency = _normalised_saliency(level, checked_sigma)
            # On a CPU, selection by arithmetic is much faster than argmax and gather.
            field = torch.lerp(field, level_field, (level_saliency > saliency).to(field.dtype))
            saliency, lowest = torch.maximum(saliency, level_saliency), torch.minimum(lowest, level_saliency)
        return (field * (lowest > limit),)

    return apply_to_photograph(layer, image)


def _check_scales(
    scales: int, smoothing: str, conductance: str, diffusion_time: float | None, threshold: float | None
) -> tuple[list[float], float]:
    """Returns the diffusion times of the smoothed levels, and T."""
    check_option(smoothing, SMOOTHINGS, "smoothing")
    check_option(conductance, CONDUCTANCES, "conductance")
    if scales < 1:
        raise InvalidInputError(f"scales: expected >= 1, got {scales}")
    limit = math.exp(-scales) if threshold is None else threshold
    if not 0 <= limit < 1:
        raise InvalidInputError(f"threshold: expected 0 <= threshold < 1, got {threshold}")
    last = check_positive(2.0 ** (scales - 2) if diffusion_time is None else diffusion_time, "diffusion_time")
    return [last * 2.0 ** (k - scales) for k in range(2, scales + 1)], limit


def _normalised_saliency(level: Tensor, sigma: float | Tensor) -> tuple[Tensor, Tensor]:
    """Vectors of the image CS of one level, and their lengths, with maximum 1 over the image."""
    gx, gy = central_gradient(smooth(level, sigma))
    saliency = squared_length(gx, gy)
    peak = image_maximum(saliency)
    saliency = saliency / torch.where(peak > 0, peak, 1.0)
    return stack_channels(*scaled_direction(saliency, gx, gy)), saliency


class MultiScaleCurvilinearSaliency(OptionsModule):
    """Module twin of :func:`multiscale_curvilinear_saliency`.

    Args:
        scales, sigma, smoothing, kappa, conductance, diffusion_time, threshold: as in the function.
        learnable: make sigma and kappa positive parameters.

    Shape:
        Input (B, 1, H, W) grey levels or (B, 3, H, W) RGB; output (B, 2, H, W).

    Example:
        >>> MultiScaleCurvilinearSaliency(scales=3)(torch.rand(2, 3, 32, 32)).shape
        torch.Size([2, 2, 32, 32])
    """

    LEARNABLE = ("sigma", "kappa")

    def __init__(
        self,
        *,
        scales: int = 5,
        sigma: float = 1.0,
        smoothing: str = "perona-malik",
        kappa: float = 0.03,
        conductance: str = "rational",
        diffusion_time: float | None = None,
        threshold: float | None = None,
        learnable: bool = False,
    ) -> None:
        _check_scales(scales, smoothing, conductance, diffusion_time, threshold)
        check_scalar(sigma, "sigma", zero_ok=True), check_scalar(kappa, "kappa")
        super().__init__(
            learnable,
            scales=scales,
            sigma=sigma,
            smoothing=smoothing,
            kappa=kappa,
            conductance=conductance,
            diffusion_time=diffusion_time,
            threshold=threshold,
        )

    def forward(self, image: Tensor) -> Tensor:
        return multiscale_curvilinear_saliency(image, **self.options)
