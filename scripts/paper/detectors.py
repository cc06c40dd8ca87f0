"""The 2D detectors that the paper compares: photograph in, response map and feature points out.

``DETECTORS[name](image, fraction=0.04)`` takes (B, 1, H, W) grey levels in [0, 1], or (B, 3, H, W) RGB, and returns a
:class:`Detection`.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar, cast

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from kornia.feature import gftt_response, harris_response
from torch import Tensor

from curvireg_torch.features import field_points
from curvireg_torch.features.hog import strongest_points
from curvireg_torch.filters import (
    image_gradient,
    multiscale_curvilinear_saliency,
    multiscale_focus_curves,
    principal_curvature_image,
)
from curvireg_torch.filters.operations import (
    at_least_float32,
    central_derivatives,
    image_maximum,
    replicate_pad,
    safe_sqrt,
    smooth,
    to_grey,
)

__all__ = ["DETECTORS", "Detection"]

Function = TypeVar("Function", bound=Callable[..., "Detection"])


class Detection(NamedTuple):
    """Response map and feature points of a detector."""

    response: Tensor
    """(B, 1, H, W) float32 or float64 >= 0, in a unit that depends on the detector."""

    points: Tensor
    """(B, 1, H, W) bool feature points, at most the requested fraction of the pixels except for ties."""


def detector(function: Function) -> Function:
    """Decorator that lets a detector on grey levels accept RGB and half types."""

    @functools.wraps(function)
    def on_photograph(image: Tensor, **options: float) -> Detection:
        return function(to_grey(at_least_float32(image)), **options)

    return cast(Function, on_photograph)


def detection_from_field(field: Tensor, fraction: float) -> Detection:
    """Length of a vector field, and its maxima across the direction of the field."""
    response = safe_sqrt(field.square().sum(dim=1, keepdim=True))
    return Detection(response, field_points(field, fraction=fraction))


def detection_from_peaks(response: Tensor, fraction: float) -> Detection:
    """The positive part of a response map, and its maxima over 3 x 3 px."""
    response = response.clamp(min=0.0)
    peaks = response == F.max_pool2d(response, 3, stride=1, padding=1)
    return Detection(response, strongest_points(response, peaks & (response > 0), fraction))


def to_uint8_images(image: Tensor) -> list[Tensor]:
    """Each image as (H, W) uint8 in CPU memory, as OpenCV needs it."""
    return list((image.detach().float().clamp(0.0, 1.0) * 255.0).round().byte().cpu()[:, 0])


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
    gradient = image_gradient(image, sigma=1.0)
    peak = image_maximum(gradient.abs())
    relative = gradient / torch.where(peak > 0, peak, 1.0)
    zero = torch.exp(-0.5 * (relative / width).square()).amin(dim=1, keepdim=True)
    length = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
    return detection_from_field((1.0 - zero) * gradient / torch.where(length > 0, length, 1.0), fraction)


OCTAVES = ((9, 15, 21, 27), (15, 27, 39, 51), (27, 51, 75, 99))
"""Sides in px of the box filters, as in Bay et al.; a side of 9 corresponds to a Gaussian of sigma 1.2 px."""


@detector
def fast_hessian(image: Tensor, *, threshold: float = 1e-4, fraction: float = 0.04) -> Detection:
    r"""Fast-Hessian (Bay et al. 2008): determinant of a Hessian of box filters, the detector of SURF.

    Own code, because OpenCV packages come without SURF. The second derivatives are box sums divided by the filter area;
    the response is the largest :math:`D_{xx} D_{yy} - (0.9 D_{xy})^2` over all filter sides, where positive. Points are
    maxima above ``threshold`` > 0 over 3 x 3 px and three neighbouring sides of an octave. Every octave is sampled at
    every pixel, without sub-pixel refinement. Filters larger than the image are skipped; borders are replicated.
    Computed in float64 on the CPU.
    """
    H, W = image.shape[-2:]
    x = image.detach().to("cpu", torch.float64)
    determinants = {side: _determinant(x, side) for side in sorted(set(sum(OCTAVES, ()))) if side <= max(min(H, W), 9)}
    response = torch.stack(list(determinants.values())).amax(dim=0).clamp(min=0.0)
    best = torch.zeros_like(response)
    for octave in OCTAVES:
        stack = [determinants[side] for side in octave if side in determinants]
        if len(stack) < 3 or len(image) == 0:
            continue
        volume = torch.cat(stack, dim=1)[:, None]  # (B, 1, sides, H, W)
        peaks = F.max_pool3d(volume, 3, stride=1, padding=1)[:, 0, 1:-1]
        inner = volume[:, 0, 1:-1]
        strength = torch.where((inner == peaks) & (inner > threshold), inner, 0.0)
        best = torch.maximum(best, strength.amax(dim=1, keepdim=True))
    points = strongest_points(best, best > 0, fraction)
    return Detection(response.float().to(image.device), points.to(image.device))


def _determinant(x: Tensor, side: int) -> Tensor:
    """det of the box Hessian with filters of side x side px, side = 3 lobe."""
    H, W = x.shape[-2:]
    lobe, radius = side // 3, side // 2
    integral = F.pad(F.pad(x, (radius,) * 4, mode="replicate").cumsum(-1).cumsum(-2), (1, 0, 1, 0))

    def box(y0: int, x0: int, height: int, width: int) -> Tensor:
        """Sum over the box whose top-left pixel is at (y0, x0) relative to the filter centre."""
        top, left = y0 + radius, x0 + radius

        def corner(dy: int, dx: int) -> Tensor:
            return integral[..., top + dy : top + dy + H, left + dx : left + dx + W]

        return corner(height, width) - corner(0, width) - corner(height, 0) + corner(0, 0)

    # Three lobes side by side, (2 lobe - 1) px across: +1, -2, +1 (Bay et al., fig. 2).
    across, half = 2 * lobe - 1, lobe // 2
    xx = box(-lobe + 1, -radius, across, side) - 3.0 * box(-lobe + 1, -half, across, lobe)
    yy = box(-radius, -lobe + 1, side, across) - 3.0 * box(-half, -lobe + 1, lobe, across)
    xy = box(-lobe, -lobe, lobe, lobe) + box(1, 1, lobe, lobe) - box(-lobe, 1, lobe, lobe) - box(1, -lobe, lobe, lobe)
    area = float(side * side)
    return (xx * yy - (0.9 * xy) ** 2) / area**2


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
    response = torch.zeros(image.shape, dtype=torch.float32)
    H, W = image.shape[-2:]
    detector = cv2.SIFT.create(nfeatures=max(1, int(fraction * H * W)))
    for i, grey in enumerate(to_uint8_images(image)):
        for keypoint in detector.detect(grey.numpy(), None):
            x, y = (min(max(round(c), 0), n - 1) for c, n in zip(keypoint.pt, (W, H), strict=True))
            response[i, 0, y, x] = max(float(response[i, 0, y, x]), keypoint.response)
    response = response.to(image.device)
    return Detection(response, response > 0)


DETECTORS: dict[str, Callable[..., Detection]] = {
    "mfc": focus_curves,
    "mcs": multiscale_saliency,
    "ig": gradient,
    "pci": principal_curvature,
    "sobel": sobel,
    "log": laplacian_of_gaussian,
    "canny": canny,
    "fuzzy": fuzzy_edges,
    "harris": harris,
    "mineig": minimum_eigenvalue,
    "sift": sift,
    "surf": fast_hessian,
}
"""Every detector of the comparison by its short name, the detectors of the paper first."""
