"""Harris and minimum-eigenvalue corners, by kornia."""

from kornia.feature import gftt_response, harris_response
from torch import Tensor

from .base import Detection, detector, from_peaks


@detector
def harris(image: Tensor, *, k: float = 0.04, share: float = 0.04) -> Detection:
    """Harris and Stephens (1988): det - k trace^2 of the structure tensor (Sobel, Gaussian window), where positive."""
    if len(image) == 0:
        return from_peaks(image, share)
    return from_peaks(harris_response(image, k=k), share)


@detector
def minimum_eigenvalue(image: Tensor, *, share: float = 0.04) -> Detection:
    """Shi and Tomasi (1994): the smaller eigenvalue of the structure tensor (Sobel, Gaussian window)."""
    if len(image) == 0:
        return from_peaks(image, share)
    return from_peaks(gftt_response(image), share)
