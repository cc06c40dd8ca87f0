"""Harris and minimum-eigenvalue corners, by kornia."""

from kornia.feature import gftt_response, harris_response
from torch import Tensor

from .base import Detection, detection_from_peaks, detector


@detector
def harris(image: Tensor, *, k: float = 0.04, fraction: float = 0.04) -> Detection:
    """Harris and Stephens (1988): det - k trace^2 of the structure tensor (Sobel, Gaussian window), where positive."""
    return detection_from_peaks(harris_response(image, k=k) if len(image) else image, fraction)


@detector
def minimum_eigenvalue(image: Tensor, *, fraction: float = 0.04) -> Detection:
    """Shi and Tomasi (1994): the smaller eigenvalue of the structure tensor (Sobel, Gaussian window)."""
    return detection_from_peaks(gftt_response(image) if len(image) else image, fraction)
