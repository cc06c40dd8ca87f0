"""SIFT, by OpenCV."""

import cv2
import torch
from torch import Tensor

from ..utils.checks import check_share
from .base import Detection, detector, grey_bytes


@detector
def sift(image: Tensor, *, share: float = 0.04) -> Detection:
    """SIFT keypoints (Lowe 2004) by OpenCV with its defaults, each at the pixel nearest to it. Runs on the CPU.

    The response is OpenCV's contrast of the keypoint at its pixel (the largest where several meet), 0 elsewhere.
    """
    check_share(share, "share")
    greys = grey_bytes(image)
    response = torch.zeros(image.shape, dtype=torch.float32)
    H, W = image.shape[-2:]
    detector = cv2.SIFT.create(nfeatures=max(1, int(share * H * W)))
    for i, grey in enumerate(greys):
        for keypoint in detector.detect(grey.numpy(), None):
            x, y = (min(max(round(c), 0), n - 1) for c, n in zip(keypoint.pt, (W, H), strict=True))
            response[i, 0, y, x] = max(float(response[i, 0, y, x]), keypoint.response)
    response = response.to(image.device)
    return Detection(response, response > 0)
