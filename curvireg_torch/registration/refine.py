"""Coarse-to-fine search around the best views of a ranking (the paper's section "Registration of 2D images")."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry.translation import place_view
from ..geometry.viewpoint import rotation_error
from ..matching import ViewDescriber, normalized_correlation

__all__ = ["RefinedPose", "coherent_views", "refine_pose"]

TOLERANCE = 0.05
"""|T_i^-1 T_(i+1) - Id|_F at which the search stops, translation in object radii (METHOD 6)."""

REACH = 15.0
"""Degrees: half as far again as the neighbours in a bank of 10 degrees, which were found worse."""

FINEST_STEP = 1.0
"""Degrees: finer steps move the contours of a crop by less than a pixel."""


@dataclass(frozen=True)
class RefinedPose:
    """A view (allocentric rotation and distance, model units) with its similarity to the photograph."""

    rotation: Tensor
    distance: float
    score: float
    iterations: int


def coherent_views(rotations: Tensor, order: Tensor, *, count: int = 5, angle: float = REACH) -> Tensor:
    """The best ``count`` views, less those farther than ``angle`` degrees from the first.

    Args:
        rotations: (N, 3, 3).
        order: (N,) view indices, best first.

    Returns:
        (K,) view indices, 1 <= K <= count.
    """
    best = order[:count]
    return best[rotation_error(rotations[best], rotations[best[:1]]) <= angle]


def refine_pose(
    describe: ViewDescriber,
    query: Tensor,
    rotations: Tensor,
    *,
    distance: float,
    radius: float,
    box: Tensor | None = None,
    camera_matrix: Tensor | None = None,
    step: float = 10.0,
    max_iterations: int = 12,
) -> RefinedPose:
    """Search between coherent views in ever smaller steps until the pose stops moving.

    The first round compares the views themselves. Every further round takes the 26 turns by +-step about the camera's
    axes around the best pose; the step halves whenever nothing is better. With a camera matrix, the distance follows in
    closed form from the box after every round, so that perspective is that of the photograph. The search keeps within
    ``REACH`` degrees of the first view.

    Args:
        describe: renders the mesh.
        query: (1, D) descriptor of the photograph's crop, as ``describe`` makes them.
        rotations: (K, 3, 3) coherent views (:func:`coherent_views`), best first.
        distance: of the object's centre in the bank's views, model units.
        radius: of the object, model units.
        box, camera_matrix: (4,) px and (3, 3) of the photograph; both or none.
        step: first step in degrees, about the spacing of the bank.
        max_iterations: rounds at most.
    """
    axes = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    offsets = torch.cartesian_prod(axes, axes, axes)
    offsets = offsets[offsets.abs().sum(dim=1) > 0]
    best, z = rotations[0].double(), distance
    candidates = rotations.double()
    score, step = -1.0, step / 2.0
    rounds = 0
    while rounds < max_iterations:
        rounds += 1
        views = describe(candidates, torch.full((len(candidates),), z, dtype=torch.float64))
        scores = normalized_correlation(query, views.descriptors)[0]
        winner = int(scores.argmax())
        previous, previous_z = best, z
        improved = float(scores[winner]) > score
        if improved:
            best, score = candidates[winner], float(scores[winner])
            if camera_matrix is not None and box is not None:
                R, t = place_view(describe.hull, best, box, camera_matrix)
                z = float(torch.linalg.vector_norm(R @ describe.centre + t))
        if rounds > 1 and step <= FINEST_STEP and _moved(previous, best, previous_z, z, radius) <= TOLERANCE:
            break
        if rounds > 1 and not improved:
            step = max(step / 2.0, FINEST_STEP)
        turns = torch.linalg.matrix_exp(_skew(torch.deg2rad(offsets * step)))
        candidates = turns @ best
        candidates = candidates[rotation_error(candidates, rotations[:1].double()) <= REACH]
    return RefinedPose(best, z, score, rounds)


def _moved(R1: Tensor, R2: Tensor, z1: float, z2: float, radius: float) -> float:
    return float(torch.linalg.matrix_norm(R1.T @ R2 - torch.eye(3, dtype=R1.dtype)) + abs(z2 - z1) / radius)


def _skew(w: Tensor) -> Tensor:
    """(K, 3, 3) cross-product matrices of (K, 3) vectors."""
    x, y, z = w.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).view(-1, 3, 3)
