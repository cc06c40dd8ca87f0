"""Edge detectors: Sobel, Laplacian of Gaussian, Canny and fuzzy logic."""

import cv2
import numpy as np
import torch
from torch import Tensor

from ..features.points import strongest_points
from ..filters import image_gradient
from ..filters.derivatives import central_derivatives, replicate_pad, smooth
from ..filters.numerics import image_maximum, safe_sqrt
from ..utils.checks import check_fraction, check_positive
from .base import Detection, detection_from_field, detector, to_uint8_images


def sobel_gradient(image: Tensor) -> Tensor:
    """(B, 2, H, W) gradient of (B, 1, H, W) by the Sobel kernels, per px (their sums divided by 8)."""
    p = replicate_pad(image, 1)
    along_x, along_y = p[..., 2:] - p[..., :-2], p[..., 2:, :] - p[..., :-2, :]
    gx = along_x[..., :-2, :] + 2.0 * along_x[..., 1:-1, :] + along_x[..., 2:, :]
    gy = along_y[..., :-2] + 2.0 * along_y[..., 1:-1] + along_y[..., 2:]
    return torch.cat([gx, gy], dim=1) / 8.0


@detector
def sobel(image: Tensor, *, fraction: float = 0.04) -> Detection:
    """Gradient by the Sobel kernels per px, borders replicated."""
    return detection_from_field(sobel_gradient(image), fraction)


@detector
def laplacian_of_gaussian(image: Tensor, *, sigma: float = 2.0, fraction: float = 0.04) -> Detection:
    """Zero crossings of the Laplacian of the image smoothed by ``sigma`` px (Marr and Hildreth 1980).

    A pixel is a crossing where the sign of the Laplacian differs from that of the right or the lower neighbour, or
    where the Laplacian is 0 between opposite neighbours of opposite sign. The response is the largest of these steps in
    grey levels per px^2, and 0 elsewhere.
    """
    check_positive(sigma, "sigma")
    _, _, xx, yy, _ = central_derivatives(smooth(image, sigma))
    laplacian = xx + yy
    response = torch.zeros_like(laplacian)
    for dim in (-1, -2):
        n = laplacian.shape[dim] - 1
        here, there = laplacian.narrow(dim, 0, n), laplacian.narrow(dim, 1, n)
        step = torch.where(here * there < 0, (here - there).abs(), 0.0)
        border = torch.zeros_like(laplacian.narrow(dim, 0, 1))
        response = torch.maximum(response, torch.cat([step, border], dim=dim))
        if n > 1:
            before, at, after = (laplacian.narrow(dim, i, n - 1) for i in range(3))
            through = torch.where((at == 0) & (before * after < 0), 0.5 * (after - before).abs(), 0.0)
            response = torch.maximum(response, torch.cat([border, through, border], dim=dim))
    return Detection(response, strongest_points(response, response > 0, fraction))


@detector
def canny(image: Tensor, *, sigma: float = 1.4, edges: float = 0.3, fraction: float = 0.04) -> Detection:
    """Canny (1986) by OpenCV on the CPU, with thresholds set per image as in MATLAB's ``edge``.

    The response is the length of the Sobel gradient of the smoothed image per px. The fraction ``edges``, in (0, 1], of
    the pixels exceeds the upper threshold; the lower threshold is 0.4 times as high.
    """
    check_positive(sigma, "sigma")
    check_fraction(edges, "edges")
    responses, points = [], []
    for grey in to_uint8_images(image):
        # cv2.Canny takes 16-bit integer derivatives: use steps of 1/32 grey level.
        blurred = cv2.GaussianBlur(grey.numpy().astype("float32"), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        dx, dy = (
            cv2.Sobel(blurred, cv2.CV_32F, *order, ksize=3, borderType=cv2.BORDER_REPLICATE)
            for order in ((1, 0), (0, 1))
        )
        length = safe_sqrt(torch.from_numpy(dx) ** 2 + torch.from_numpy(dy) ** 2)
        # torch.quantile refuses more than 16 million pixels.
        high = max(float(np.quantile(length.numpy(), 1.0 - edges)), 1e-3) * 32.0
        mask = cv2.Canny(
            (dx * 32.0).round().astype("int16"), (dy * 32.0).round().astype("int16"), 0.4 * high, high, L2gradient=True
        )
        responses.append(length / (8.0 * 255.0))
        points.append(torch.from_numpy(mask) > 0)
    if not responses:
        return Detection(torch.zeros_like(image, dtype=torch.float32), torch.zeros_like(image, dtype=torch.bool))
    response = torch.stack(responses)[:, None].to(image.device)
    return Detection(response, strongest_points(response, torch.stack(points)[:, None].to(image.device), fraction))


@detector
def fuzzy_edges(image: Tensor, *, width: float = 0.1, fraction: float = 0.04) -> Detection:
    r"""Edges by fuzzy rules on the two derivatives, each divided by the largest derivative of the image.

    With "zero" as :math:`\mu(g) = \exp(-g^2 / (2\,\mathrm{width}^2))` and AND as min, a pixel is uniform (0) if I_x is
    zero and I_y is zero, and an edge (1) otherwise. The response is the mean of 0 and 1 weighted by the truth of each
    rule (Sugeno), :math:`1 - \min(\mu(I_x), \mu(I_y))`. Points are its maxima along the gradient.
    """
    check_positive(width, "width")
    gradient = image_gradient(image, sigma=1.0)
    peak = image_maximum(gradient.abs())
    relative = gradient / torch.where(peak > 0, peak, 1.0)
    zero = torch.exp(-0.5 * (relative / width).square()).amin(dim=1, keepdim=True)
    length = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
    return detection_from_field((1.0 - zero) * gradient / torch.where(length > 0, length, 1.0), fraction)
