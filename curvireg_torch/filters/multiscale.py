"""Multi-scale curvilinear saliency (MCS) of photographs over an edge-preserving scale space."""

import math

import torch
from torch import Tensor, nn

from .._checks import check_image
from ..errors import InvalidInputError
from .curvilinear import image_curvilinear_saliency
from .derivatives import at_least_float32, image_maximum, safe_sqrt
from .diffusion import anisotropic_diffusion

__all__ = ["MultiScaleCurvilinearSaliency", "multiscale_curvilinear_saliency"]

FIRST_ITERATIONS = 5
"""Diffusion steps of the first smoothed level; each further level doubles the total (0, 5, 10, 20, 40, ...)."""


def multiscale_curvilinear_saliency(
    image: Tensor,
    *,
    scales: int = 5,
    sigma: float | Tensor = 1.0,
    kappa: float | Tensor = 0.03,
    conductance: str = "rational",
    threshold: float | None = None,
) -> Tensor:
    r"""MCS (the paper's section "Multi-Curvilinear Saliency"): edges that survive edge-preserving diffusion.

    The image curvilinear saliency :math:`|\nabla I|^2` of every level, divided by its own maximum over the image, is
    compared with T. Where *every* level exceeds T the largest level is kept, elsewhere the field is 0.

    Args:
        image: (B, 1, H, W) grey levels in [0, 1].
        scales: number n of levels, the image itself included; diffused 0, 5, 10, 20, ... steps.
        sigma: smoothing in px before differentiation.
        kappa, conductance: of :func:`anisotropic_diffusion`.
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
    check_image(image)
    if scales < 1:
        raise InvalidInputError(f"scales: expected >= 1, got {scales}")
    limit = math.exp(-scales) if threshold is None else threshold
    if not 0 <= limit < 1:
        raise InvalidInputError(f"threshold: expected 0 <= threshold < 1, got {threshold}")
    level, done = at_least_float32(image), 0
    fields: list[Tensor] = []
    for k in range(scales):
        total = FIRST_ITERATIONS * 2 ** (k - 1) if k else 0
        level, done = anisotropic_diffusion(level, iterations=total - done, kappa=kappa, conductance=conductance), total
        field = image_curvilinear_saliency(level, sigma=sigma)
        peak = image_maximum(safe_sqrt(field.square().sum(dim=1, keepdim=True)))
        fields.append(field / torch.where(peak > 0, peak, torch.ones_like(peak)))
    stack = torch.stack(fields, dim=1)
    saliency = safe_sqrt(stack.square().sum(dim=2))
    best = saliency.argmax(dim=1)[:, None, None].expand(-1, -1, 2, -1, -1)
    kept = (saliency > limit).all(dim=1, keepdim=True)
    return (stack.gather(1, best).squeeze(1) * kept).to(image.dtype)


class MultiScaleCurvilinearSaliency(nn.Module):
    """Module twin of :func:`multiscale_curvilinear_saliency`."""

    def __init__(
        self,
        *,
        scales: int = 5,
        sigma: float = 1.0,
        kappa: float = 0.03,
        conductance: str = "rational",
        threshold: float | None = None,
    ) -> None:
        super().__init__()
        self.scales, self.sigma, self.kappa = scales, sigma, kappa
        self.conductance, self.threshold = conductance, threshold

    def forward(self, image: Tensor) -> Tensor:
        return multiscale_curvilinear_saliency(
            image,
            scales=self.scales,
            sigma=self.sigma,
            kappa=self.kappa,
            conductance=self.conductance,
            threshold=self.threshold,
        )

    def extra_repr(self) -> str:
        return (
            f"scales={self.scales}, sigma={self.sigma}, kappa={self.kappa}, "
            f"conductance={self.conductance!r}, threshold={self.threshold}"
        )
