"""Details: poses of nearly the same look, compared only where their contours differ."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..rendering.contours import MeshContours
from ..utils.rows import Rows
from .contour_problem import ContourProblem
from .edges import EdgeCrops
from .least_squares import pixels

# Pixels of a crop from all contours of the other pose beyond which a contour point is one pose's
# alone
APART = 4.0
MIN_POINTS = 6  # Contour points of one pose alone from which two poses look different
ENOUGH_POINTS = 16  # Points from which details have their full weight
DETAILS_WEIGHT = 10.0  # Score of a contour that is there, in the units of edge support


def compare_details(
    contours: MeshContours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> tuple[Tensor, Tensor]:
    """How far the contours that only one of two poses predicts speak for it: those that are in the
    photograph count for the pose, those that are not count against it.

    Args:
        contours: of the mesh.
        crops: of photographs.
        K: (N, 3, 3) cameras of the poses.
        T: (N, 4, 4) poses.
        image_index: (N,) the crop of each pose.

    Returns:
        (N, N) scores, positive where the pose of the row is better than that of the column, 0 where
        they look alike; and (N, N) bool, whether they look different.
    """
    return compared(contour_details(contours, crops, K, T, image_index))


@dataclass(frozen=True)
class ContourDetails(Rows):
    """Contour points of N poses in crops: ``uv`` (N, P, 2) px, ``strength`` (N, P) of the edges
    there, which are ``valid`` (N, P), and which are ``counted`` (N, P), as they lie in the
    photograph."""

    uv: Tensor
    strength: Tensor
    valid: Tensor
    counted: Tensor


def contour_details(
    contours: MeshContours, crops: EdgeCrops, K: Tensor, T: Tensor, image_index: Tensor
) -> ContourDetails:
    """What :func:`compare_details` compares."""
    problem = ContourProblem.of(contours, crops, K, image_index)
    points = problem.state(T).points
    uv = pixels(points.model, T, problem.K, problem.centre)
    strength = problem.strength_near(uv, points.normals)
    counted = points.valid & (problem.edges.counts(uv, points.valid, image_index) > 0)
    return ContourDetails(uv, strength, points.valid, counted)


def compared(details: ContourDetails) -> tuple[Tensor, Tensor]:
    """The result of :func:`compare_details`."""
    uv = details.uv
    strength = details.strength
    counted = details.counted
    N = len(uv)
    total = torch.zeros(N, N, dtype=torch.float64)
    count = torch.zeros(N, N, dtype=torch.float64)
    for a in range(N):
        for b in range(N):
            alone = counted[a] & _is_apart(uv[a], uv[b][details.valid[b]])
            shared = counted[a] & ~alone
            # Half of what contours have that both poses predict: the middle between a contour and
            # none.
            middle = 0.5 * strength[a][shared].sum() / shared.sum().clamp(min=1)
            total[a, b] = ((strength[a] - middle) * alone).sum()
            count[a, b] = alone.sum()
    differ = torch.maximum(count, count.T)
    scores = DETAILS_WEIGHT * (total - total.T) / differ.clamp(min=ENOUGH_POINTS)
    looks_different = differ >= MIN_POINTS
    return torch.where(looks_different, scores, 0.0), looks_different


def _is_apart(uv: Tensor, others: Tensor) -> Tensor:
    """(P,) bool: points (P, 2) that are far from all others (Q, 2)."""
    if not len(others):
        return torch.ones(len(uv), dtype=torch.bool)
    return torch.cdist(uv, others).amin(dim=1) > APART
