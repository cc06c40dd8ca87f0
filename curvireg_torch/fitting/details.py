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
    uv = pixels(points.model, T, problem.K)
    strength = problem.strength_near(uv, points.normals)
    counted = points.valid & (problem.edges.counts(uv, points.valid, image_index) > 0)
    return ContourDetails(uv, strength, points.valid, counted)


def compared(details: ContourDetails) -> tuple[Tensor, Tensor]:
    """The result of :func:`compare_details`."""
    N = len(details.uv)
    first, second = torch.triu_indices(N, N, 1).unbind(0)
    score, differs = compare_pairs(details, first, second)
    scores = torch.zeros(N, N, dtype=torch.float64)
    scores[first, second] = score
    look_different = torch.zeros(N, N, dtype=torch.bool)
    look_different[first, second] = differs
    return scores - scores.T, look_different | look_different.T


def compare_pairs(details: ContourDetails, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`compare_details` of M pairs of poses, of one photograph or of many: ``first`` and
    ``second`` (M,) are their rows. (M,) scores, positive where the first is better, and (M,) bool,
    whether they look different."""
    distance = torch.cdist(details.uv[first], details.uv[second])
    # what is valid and lies outside the photograph is near, too
    to_second = distance.masked_fill(~details.valid[second, None], torch.inf).amin(dim=2)
    to_first = distance.masked_fill(~details.valid[first][:, :, None], torch.inf).amin(dim=1)
    gain, count = _alone(details, first, to_second > APART)
    gain_of_second, count_of_second = _alone(details, second, to_first > APART)
    differ = torch.maximum(count, count_of_second)
    scores = DETAILS_WEIGHT * (gain - gain_of_second) / differ.clamp(min=ENOUGH_POINTS)
    looks_different = differ >= MIN_POINTS
    return torch.where(looks_different, scores, 0.0), looks_different


def _alone(details: ContourDetails, rows: Tensor, is_apart: Tensor) -> tuple[Tensor, Tensor]:
    """(M,) by how much the strength of the points (M, P) that only these poses have exceeds the
    middle between a contour and none, summed; and (M,) their number."""
    strength = details.strength[rows]
    counted = details.counted[rows]
    alone = counted & is_apart
    shared = counted & ~is_apart
    # half of what contours have that both poses predict
    middle = 0.5 * (strength * shared).sum(dim=1) / shared.sum(dim=1).clamp(min=1)
    return ((strength - middle[:, None]) * alone).sum(dim=1), alone.sum(dim=1).double()
