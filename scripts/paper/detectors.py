"""The 2D detectors that the paper compares.

``DETECTORS[name](image, fraction)`` takes (1, 1, H, W) grey levels in [0, 1] and returns the
feature points, (1, 1, H, W) bool: at most the fraction of the pixels except for ties.
"""

from collections.abc import Callable
from typing import TypeAlias

import cv2
import numpy as np
import skimage.feature
import torch
import torch.nn.functional as F
from kornia.feature import gftt_response, harris_response
from kornia.filters import spatial_gradient
from torch import Tensor

from curvireg_torch.features import field_points
from curvireg_torch.features.fields import FIELDS
from curvireg_torch.features.hog import strongest_points
from curvireg_torch.filters import (
    image_gradient,
    multiscale_curvilinear_saliency,
    multiscale_focus_curves,
    principal_curvature_image,
)
from curvireg_torch.filters.operations import central_derivatives, image_maximum, smooth

Detector: TypeAlias = Callable[[Tensor, float], Tensor]


def peaks(response: Tensor, fraction: float) -> Tensor:
    """The strongest positive maxima over 3 x 3 px of a response map."""
    response = response.clamp(min=0.0)
    largest = response == F.max_pool2d(response, 3, stride=1, padding=1)
    return strongest_points(response, largest & (response > 0), fraction)


def sobel(image: Tensor, fraction: float) -> Tensor:
    """Gradient by the Sobel kernels per px (their sums divided by 8), borders replicated."""
    return field_points(spatial_gradient(image)[:, 0], fraction=fraction)


def laplacian_of_gaussian(image: Tensor, fraction: float) -> Tensor:
    """Zero crossings of the Laplacian of the image smoothed by 2 px (Marr and Hildreth 1980).

    A pixel is a crossing where the sign of the Laplacian differs from that of the right or the
    lower neighbour; the larger of these steps is its strength.
    """
    _, _, xx, yy, _ = central_derivatives(smooth(image, 2.0))
    laplacian = F.pad(xx + yy, (0, 1, 0, 1), mode="replicate")
    here = laplacian[..., :-1, :-1]
    steps = []
    for neighbour in (laplacian[..., :-1, 1:], laplacian[..., 1:, :-1]):
        crosses = here * neighbour < 0
        steps.append(torch.where(crosses, (here - neighbour).abs(), 0.0))
    response = torch.maximum(*steps)
    return strongest_points(response, response > 0, fraction)


def canny(image: Tensor, fraction: float) -> Tensor:
    """Canny (1986) by scikit-image, sigma 1.4 px; as in MATLAB's ``edge``, 30 % of the pixels
    exceed the upper threshold, and the lower one is 0.4 times as high."""
    gradient = spatial_gradient(smooth(image, 1.4, margin=0))[:, 0]
    response = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
    # scikit-image divides its Sobel sums by 4
    high = 4.0 * float(np.quantile(response.numpy(), 0.7))
    grey = image[0, 0].double().numpy()
    edges = skimage.feature.canny(grey, 1.4, 0.4 * high, high, mode="nearest")
    return strongest_points(response, torch.from_numpy(edges)[None, None], fraction)


def fuzzy_edges(image: Tensor, fraction: float) -> Tensor:
    r"""Edges by fuzzy rules on the two derivatives, each divided by the largest derivative of the
    image.

    With "zero" as :math:`\mu(g) = \exp(-g^2 / (2 \cdot 0.1^2))` and AND as min, a pixel is
    uniform (0) if I_x is zero and I_y is zero, and an edge (1) otherwise. Points are the maxima
    along the gradient of the mean of 0 and 1 weighted by the truth of each rule (Sugeno),
    :math:`1 - \min(\mu(I_x), \mu(I_y))`.
    """
    gradient = image_gradient(image, sigma=1.0)
    peak = image_maximum(gradient.abs())
    relative = gradient / torch.where(peak > 0, peak, 1.0)
    zero = torch.exp(-0.5 * (relative / 0.1).square()).amin(dim=1, keepdim=True)
    length = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
    edges = (1.0 - zero) * gradient / torch.where(length > 0, length, 1.0)
    return field_points(edges, fraction=fraction)


SIDES = (9, 15, 21, 27, 39, 51, 75, 99)
"""Sides in px of the box filters, as in Bay et al.; a side of 9 corresponds to a Gaussian of sigma
1.2 px."""


def fast_hessian(image: Tensor, fraction: float) -> Tensor:
    """Fast-Hessian (Bay et al. 2008), the detector of SURF: determinants of a Hessian of box
    filters by scikit-image.

    Points are maxima above 1e-4 over 3 x 3 px and three neighbouring sides.
    """
    H, W = image.shape[-2:]
    sides = [side for side in SIDES if side <= max(21, H, W)]
    grey = F.pad(image.double(), (50,) * 4, mode="replicate")[0, 0].numpy()
    found = [skimage.feature.hessian_matrix_det(grey, side / 3) for side in sides]
    volume = torch.tensor(np.array(found), dtype=torch.float32)[None, None]
    # scikit-image's result is one pixel too far up and left
    volume = volume[..., 49 : 49 + H, 49 : 49 + W]
    inner = volume[:, :, 1:-1]
    largest = F.max_pool3d(volume, 3, stride=1, padding=(0, 1, 1))
    best = torch.where((inner == largest) & (inner > 1e-4), inner, 0.0).amax(dim=2)
    return strongest_points(best, best > 0, fraction)


def harris(image: Tensor, fraction: float) -> Tensor:
    """Harris and Stephens (1988): det - 0.04 trace^2 of the structure tensor (Sobel, Gaussian
    window), where positive."""
    return peaks(harris_response(image, k=0.04), fraction)


def minimum_eigenvalue(image: Tensor, fraction: float) -> Tensor:
    """Shi and Tomasi (1994): the smaller eigenvalue of the structure tensor (Sobel, Gaussian
    window)."""
    return peaks(gftt_response(image), fraction)


def sift(image: Tensor, fraction: float) -> Tensor:
    """SIFT keypoints (Lowe 2004) by OpenCV with its defaults on the CPU, each rounded to the
    nearest pixel."""
    points = torch.zeros(image.shape, dtype=torch.bool)
    H, W = image.shape[-2:]
    found = cv2.SIFT.create(nfeatures=max(1, int(fraction * H * W)))
    grey = (255.0 * image[0, 0].clamp(0.0, 1.0)).round().byte()
    for keypoint in found.detect(grey.numpy(), None):
        x = min(max(round(keypoint.pt[0]), 0), W - 1)
        y = min(max(round(keypoint.pt[1]), 0), H - 1)
        points[0, 0, y, x] |= keypoint.response > 0
    return points


def of_field(field: Callable[[Tensor], Tensor]) -> Detector:
    """The detector of a filter of the library."""
    return lambda image, fraction: field_points(field(image), fraction=fraction)


DETECTORS: dict[str, Detector] = {
    "mfc": of_field(FIELDS["MFC"]()),
    "mfc x cs": of_field(multiscale_focus_curves),
    "mcs": of_field(multiscale_curvilinear_saliency),
    "ig": of_field(image_gradient),
    "pci": of_field(principal_curvature_image),
    "sobel": sobel,
    "log": laplacian_of_gaussian,
    "canny": canny,
    "fuzzy": fuzzy_edges,
    "harris": harris,
    "mineig": minimum_eigenvalue,
    "sift": sift,
    "surf": fast_hessian,
}
"""Every detector of the comparison by its short name, the detectors of the paper first; "mfc x cs"
is ours."""
