"""The paper's own fields and PCI as detectors."""

from torch import Tensor

from ..filters import (
    image_gradient,
    multiscale_curvilinear_saliency,
    multiscale_focus_curves,
    principal_curvature_image,
)
from .base import Detection, detector, from_field


@detector
def focus_curves(image: Tensor, *, share: float = 0.04) -> Detection:
    """MFC, :func:`curvireg_torch.filters.multiscale_focus_curves` with its defaults."""
    return from_field(multiscale_focus_curves(image), share)


@detector
def multiscale_saliency(image: Tensor, *, share: float = 0.04) -> Detection:
    """MCS, :func:`curvireg_torch.filters.multiscale_curvilinear_saliency` with its defaults."""
    return from_field(multiscale_curvilinear_saliency(image), share)


@detector
def gradient(image: Tensor, *, share: float = 0.04) -> Detection:
    """IG, :func:`curvireg_torch.filters.image_gradient` with its defaults."""
    return from_field(image_gradient(image), share)


@detector
def principal_curvature(image: Tensor, *, share: float = 0.04) -> Detection:
    """PCI of the largest eigenvalue, :func:`curvireg_torch.filters.principal_curvature_image` with its defaults."""
    return from_field(principal_curvature_image(image), share)
