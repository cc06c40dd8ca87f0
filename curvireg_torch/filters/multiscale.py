"""Multi-scale curvilinear saliency (MCS) of photographs over an edge-preserving scale space."""

import math

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_option, check_positive
from .blocks import Planes, channels
from .curvilinear import along
from .derivatives import central_gradient, smooth
from .diffusion import CONDUCTANCES, diffuse
from .edge_preserving import bilateral_smooth, guided_smooth
from .inputs import on_photograph
from .learnable import as_number, check_width, keep_positive, positive_option
from .numerics import image_maximum, squared_length

__all__ = ["MultiScaleCurvilinearSaliency", "multiscale_curvilinear_saliency"]

SMOOTHINGS = ("perona-malik", "bilateral", "guided")

STEP = 0.2
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

    The image curvilinear saliency :math:`|\nabla I|^2` of every level, divided by its own maximum over the image, is
    compared with T. Where *every* level exceeds T the largest level is kept, elsewhere the field is 0.

    Args:
        image: (B, 1, H, W) grey levels in [0, 1], or (B, 3, H, W) RGB; NaN pixels are missing (0 in the result).
        scales: number n of levels, the image itself included. Each smoothed level has twice the time t of the one
            before.
        sigma: smoothing in px before differentiation.
        smoothing: ``"perona-malik"`` (:func:`anisotropic_diffusion` to time t), or ``"bilateral"`` or ``"guided"``
            with the width of linear diffusion to time t, sqrt(2 t) px.
        kappa: contrast in grey levels above which an edge is kept, for all smoothings.
        conductance: of :func:`anisotropic_diffusion`.
        diffusion_time: t of the last level, in px^2; None is 2^(n-2), that is 0, 5, 10, 20, ... steps of 0.2.
        threshold: T in [0, 1); None is the paper's :math:`e^{-n}`.

    Returns:
        (B, 2, H, W): length in [0, 1], direction of the gradient at the level that was kept. dtype kept.

    Raises:
        InvalidInputError: wrong shape, dtype or option.

    Example:
        >>> step = (torch.arange(32) >= 16).float().expand(1, 1, 32, 32)
        >>> field = multiscale_curvilinear_saliency(step)
        >>> round(float(field[0, :, 16, 16].norm()), 3)
        1.0
    """
    times, limit = _check_scales(scales, smoothing, conductance, diffusion_time, threshold)
    width, edge = check_width(sigma, "sigma", zero_ok=True), check_width(kappa, "kappa")

    def layer(image: Tensor) -> Planes:
        level, done = image, 0
        field, saliency = _normalised_saliency(level, width)
        lowest = saliency
        for time in times:
            if smoothing == "perona-malik":
                steps = max(round(time / STEP), 1)
                level = diffuse(level, max(steps - done, 0), edge, STEP, conductance)
                done = max(steps, done)
            else:
                edge_preserving = bilateral_smooth if smoothing == "bilateral" else guided_smooth
                level = edge_preserving(image, sigma=math.sqrt(2.0 * time), kappa=edge)
            level_field, level_saliency = _normalised_saliency(level, width)
            # A selection by arithmetic: on a CPU far faster than argmax and gather.
            field = torch.lerp(field, level_field, (level_saliency > saliency).to(field.dtype))
            saliency, lowest = torch.maximum(saliency, level_saliency), torch.minimum(lowest, level_saliency)
        return (field * (lowest > limit),)

    return on_photograph(layer, image)


def _check_scales(
    scales: int, smoothing: str, conductance: str, diffusion_time: float | None, threshold: float | None
) -> tuple[list[float], float]:
    """The smoothed levels' times, and T."""
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
    """CS of a level as vectors and their lengths, 1 at the image's largest."""
    gx, gy = central_gradient(smooth(level, sigma))
    saliency = squared_length(gx, gy)
    peak = image_maximum(saliency)
    saliency = saliency / torch.where(peak > 0, peak, 1.0)
    return channels(*along(saliency, gx, gy)), saliency


class MultiScaleCurvilinearSaliency(nn.Module):
    """MCS, as a layer; module twin of :func:`multiscale_curvilinear_saliency`.

    Args:
        scales: number n of levels, >= 1, the image itself included.
        sigma: smoothing in px before differentiation, >= 0.
        smoothing: ``"perona-malik"``, ``"bilateral"`` or ``"guided"``.
        kappa: contrast in grey levels above which an edge is kept, > 0.
        conductance: of :func:`anisotropic_diffusion`.
        diffusion_time: of the last level in px^2; None is 2^(n-2).
        threshold: T in [0, 1); None is e^-n.
        learnable: make the logarithms of sigma and kappa parameters, ``log_sigma`` and ``log_kappa``; then sigma > 0.

    Shape:
        Input (B, 1, H, W) grey levels or (B, 3, H, W) RGB; output (B, 2, H, W).

    Example:
        >>> import torch
        >>> MultiScaleCurvilinearSaliency(scales=3)(torch.rand(2, 3, 32, 32)).norm(dim=1).amax() <= 1.0001
        tensor(True)
    """

    sigma, kappa = positive_option("sigma"), positive_option("kappa")

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
        super().__init__()
        _check_scales(scales, smoothing, conductance, diffusion_time, threshold)
        check_width(sigma, "sigma", zero_ok=True), check_width(kappa, "kappa")
        keep_positive(self, learnable, sigma=sigma, kappa=kappa)
        self.scales, self.smoothing, self.conductance = scales, smoothing, conductance
        self.diffusion_time, self.threshold = diffusion_time, threshold

    def forward(self, image: Tensor) -> Tensor:
        return multiscale_curvilinear_saliency(
            image,
            scales=self.scales,
            sigma=self.sigma,
            smoothing=self.smoothing,
            kappa=self.kappa,
            conductance=self.conductance,
            diffusion_time=self.diffusion_time,
            threshold=self.threshold,
        )

    def extra_repr(self) -> str:
        return (
            f"scales={self.scales}, sigma={as_number(self.sigma)}, smoothing={self.smoothing!r}, "
            f"kappa={as_number(self.kappa)}, conductance={self.conductance!r}, diffusion_time={self.diffusion_time}, "
            f"threshold={self.threshold}"
        )
