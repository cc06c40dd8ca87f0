"""Names of version 0.1 that gave way to stages in batches."""

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from ..matching import ViewDescriber
from .hypotheses import Hypotheses
from .search import BRIEF, search
from .verify import similarities

__all__ = ["RefinedPose", "refine_pose"]


@dataclass(frozen=True)
class RefinedPose:
    """Deprecated: a view (allocentric rotation and distance, model units) with its similarity to the photograph.

    Attributes:
        iterations: rounds at most.
    """

    rotation: Tensor
    distance: float
    score: float
    iterations: int


def refine_pose(
    describe: ViewDescriber,
    query: Tensor,
    rotations: Tensor,
    *,
    distance: float,
    radius: float = 0.0,  # noqa: ARG001
    box: Tensor | None = None,
    camera_matrix: Tensor | None = None,
    step: float = 10.0,  # noqa: ARG001
    max_iterations: int = 12,  # noqa: ARG001
) -> RefinedPose:
    """Deprecated: :func:`search` around the best of (K, 3, 3) views, for one photograph.

    Args:
        describe: renders the mesh.
        query: (1, D) descriptor of the photograph's crop, as ``describe`` makes them.
        rotations: (K, 3, 3) views near each other.
        distance: of the object's centre in them, model units.
        box, camera_matrix: (4,) px and (3, 3) of the photograph; both or none.
        radius, step, max_iterations: no longer asked: the search knows its own.
    """
    warnings.warn("refine_pose is deprecated; use registration.search", DeprecationWarning, stacklevel=2)
    K = len(rotations)
    none, z = torch.zeros(K, dtype=torch.long), torch.full((K,), distance, dtype=torch.float64)
    views = Hypotheses(none, none, none, rotations.double().cpu(), z, torch.zeros(K, dtype=torch.float64))
    best = similarities([describe], query, views).argmax()
    boxes = None if box is None else box[None].double()
    cameras = None if camera_matrix is None else camera_matrix[None].double()
    found = search([describe], query, views[best[None]], boxes=boxes, camera_matrices=cameras, brief=True)
    return RefinedPose(found.rotation[0], float(found.distance[0]), float(found.score[0]), BRIEF)
