"""The fields of the paper and PCI as detectors, with the default options of the filters."""

from torch import Tensor

from ..filters import (
    image_gradient,
    multiscale_curvilinear_saliency,
    multiscale_focus_curves,
    principal_curvature_image,
)
from .base import Detection, detection_from_field, detector


@detector
def focus_curves(image: Tensor, *, fraction: float = 0.04) -> Detection:
    """MFC, :func:`curvireg_torch.filters.multiscale_focus_curves`."""
    return detection_from_field(multiscale_focus_curves(image), fraction)


@detector
def multiscale_saliency(image: Tensor, *, fraction: float = 0.04) -> Detection:
    """MCS, :func:`curvireg_torch.filters.multiscale_curvilinear_saliency`."""
    return detection_from_field(multiscale_curvilinear_saliency(image), fraction)


@detector
def gradient(image: Tensor, *, fraction: float = 0.04) -> Detection:
    """IG, :func:`curvireg_torch.filters.image_gradient`."""
    return detection_from_field(image_gradient(image), fraction)


@detector
def principal_curvature(image: Tensor, *, fraction: float = 0.04) -> Detection:
    """PCI of the largest eigenvalue, :func:`curvireg_torch.filters.principal_curvature_image`."""
    return detection_from_field(principal_curvature_image(image), fraction)
