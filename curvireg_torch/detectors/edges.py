"""Sobel, Laplacian of Gaussian and Canny."""

import cv2
import numpy as np
import torch
from torch import Tensor

from ..descriptors.points import strongest_points
from ..filters.derivatives import central_derivatives, replicate_pad, smooth
from ..filters.numerics import safe_sqrt
from ..utils.checks import check_positive, check_share
from .base import Detection, detector, from_field, grey_bytes


@detector
def sobel(image: Tensor, *, share: float = 0.04) -> Detection:
    """Gradient by Sobel's 3 x 3 kernels, per px (their sums divided by 8), borders replicated.

    Written out: kornia's ``spatial_gradient`` is slower, and its ``sobel`` is not 0 on flat images.
    """
    p = replicate_pad(image, 1)
    along_x = p[..., 2:] - p[..., :-2]
    along_y = p[..., 2:, :] - p[..., :-2, :]
    gx = along_x[..., :-2, :] + 2.0 * along_x[..., 1:-1, :] + along_x[..., 2:, :]
    gy = along_y[..., :-2] + 2.0 * along_y[..., 1:-1] + along_y[..., 2:]
    return from_field(torch.cat([gx, gy], dim=1) / 8.0, share)


@detector
def laplacian_of_gaussian(image: Tensor, *, sigma: float = 2.0, share: float = 0.04) -> Detection:
    """Zero crossings of the Laplacian of the image smoothed by ``sigma`` px (Marr and Hildreth 1980).

    A pixel is a crossing where the Laplacian's sign differs from the right or the lower neighbour's, or where it is 0
    between neighbours of opposite sign, left and right or above and below; its response is the largest of those steps,
    in grey levels per px^2 and px. Elsewhere the response is 0.
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
    return Detection(response, strongest_points(response, response > 0, share))


@detector
def canny(image: Tensor, *, sigma: float = 1.4, edges: float = 0.3, share: float = 0.04) -> Detection:
    """Canny (1986) by OpenCV, its thresholds set per image as MATLAB's ``edge`` sets them.

    The response is the length of the Sobel gradient of the smoothed image per px; the upper threshold leaves the share
    ``edges``, in (0, 1], of the pixels above it, the lower one is 0.4 times as high. Runs on the CPU.
    """
    check_positive(sigma, "sigma")
    check_share(edges, "edges")
    responses, points = [], []
    for grey in grey_bytes(image):
        # Derivatives as whole numbers of 16 bit, as cv2.Canny wants them, 32 times finer than a grey level.
        blurred = cv2.GaussianBlur(grey.numpy().astype("float32"), (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        dx, dy = (
            cv2.Sobel(blurred, cv2.CV_32F, *order, ksize=3, borderType=cv2.BORDER_REPLICATE)
            for order in ((1, 0), (0, 1))
        )
        length = safe_sqrt(torch.from_numpy(dx) ** 2 + torch.from_numpy(dy) ** 2)
        # NumPy's quantile: torch refuses more than 16 million pixels.
        high = max(float(np.quantile(length.numpy(), 1.0 - edges)), 1e-3) * 32.0
        mask = cv2.Canny(
            (dx * 32.0).round().astype("int16"), (dy * 32.0).round().astype("int16"), 0.4 * high, high, L2gradient=True
        )
        responses.append(length / (8.0 * 255.0))
        points.append(torch.from_numpy(mask) > 0)
    if not responses:
        return Detection(torch.zeros_like(image, dtype=torch.float32), torch.zeros_like(image, dtype=torch.bool))
    response = torch.stack(responses)[:, None].to(image.device)
    return Detection(response, strongest_points(response, torch.stack(points)[:, None].to(image.device), share))
