"""Harris and minimum-eigenvalue corners, by kornia."""

from kornia.feature import gftt_response, harris_response
from torch import Tensor

from .._checks import check_image
from ..filters.derivatives import at_least_float32
from .base import Detection, from_peaks


def harris(image: Tensor, *, k: float = 0.04, share: float = 0.04) -> Detection:
    """Harris and Stephens (1988): det - k trace^2 of the structure tensor (Sobel, Gaussian window), where positive."""
    check_image(image)
    if len(image) == 0:
        return from_peaks(at_least_float32(image), share)
    return from_peaks(harris_response(at_least_float32(image), k=k), share)


def minimum_eigenvalue(image: Tensor, *, share: float = 0.04) -> Detection:
    """Shi and Tomasi (1994): the smaller eigenvalue of the structure tensor (Sobel, Gaussian window)."""
    check_image(image)
    if len(image) == 0:
        return from_peaks(at_least_float32(image), share)
    return from_peaks(gftt_response(at_least_float32(image)), share)
