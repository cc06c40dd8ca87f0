"""The detector of SURF."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..features.points import strongest_points
from ..utils.checks import check_positive
from .base import Detection, detector

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
    check_positive(threshold, "threshold")
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
