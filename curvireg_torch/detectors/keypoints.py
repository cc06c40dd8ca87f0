"""Corners by kornia, and SIFT by OpenCV."""

import cv2
import torch
from kornia.feature import gftt_response, harris_response
from torch import Tensor

from ..utils.checks import check_fraction
from .base import Detection, detection_from_peaks, detector, to_uint8_images


@detector
def harris(image: Tensor, *, k: float = 0.04, fraction: float = 0.04) -> Detection:
    """Harris and Stephens (1988): det - k trace^2 of the structure tensor (Sobel, Gaussian window), where positive."""
    return detection_from_peaks(harris_response(image, k=k) if len(image) else image, fraction)


@detector
def minimum_eigenvalue(image: Tensor, *, fraction: float = 0.04) -> Detection:
    """Shi and Tomasi (1994): the smaller eigenvalue of the structure tensor (Sobel, Gaussian window)."""
    return detection_from_peaks(gftt_response(image) if len(image) else image, fraction)


@detector
def sift(image: Tensor, *, fraction: float = 0.04) -> Detection:
    """SIFT keypoints (Lowe 2004) by OpenCV with its defaults on the CPU, each rounded to the nearest pixel.

    The response is the contrast of the strongest keypoint at each pixel, as OpenCV computes it, and 0 elsewhere.
    """
    check_fraction(fraction, "fraction")
    response = torch.zeros(image.shape, dtype=torch.float32)
    H, W = image.shape[-2:]
    detector = cv2.SIFT.create(nfeatures=max(1, int(fraction * H * W)))
    for i, grey in enumerate(to_uint8_images(image)):
        for keypoint in detector.detect(grey.numpy(), None):
            x, y = (min(max(round(c), 0), n - 1) for c, n in zip(keypoint.pt, (W, H), strict=True))
            response[i, 0, y, x] = max(float(response[i, 0, y, x]), keypoint.response)
    response = response.to(image.device)
    return Detection(response, response > 0)
