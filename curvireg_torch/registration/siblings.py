"""Siblings of a pose: what the symmetries of a mesh's shape make of it, compared where small features differ."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
import trimesh
from torch import Tensor

from ..geometry.viewpoint import rotation_error
from ..matching import ViewDescriber
from ..mesh.symmetry import FEATURE_FRACTION, feature_fractions
from .confidence import RIVAL_ANGLE, resolution
from .poses import POSE_FEATURES, SCORE_WEIGHTS, Poses, placed, pose_scores

MAX_SIBLINGS = 12  # Symmetries that are compared, the identity among them: every 30 degrees of a body of revolution
BETTER = 0.1  # Score by which a sibling replaces the pose: more than the rounding of a mesh that is symmetric
LOOKS_DIFFERENT = 0.2  # Score that the difference of two views costs, from which they are not the same pose


@dataclass(frozen=True)
class Siblings:
    """K poses that symmetries of the shape make of one, the pose itself first.

    Attributes:
        poses: of them.
        features: (K, F) :data:`.POSE_FEATURES`, all measured in the same way, without a fit.
        likeness: (K, K) normalised correlations of their views.
    """

    poses: Poses
    features: Tensor
    likeness: Tensor

    @staticmethod
    def of(pose: Poses, symmetries: Tensor, describer: ViewDescriber, measure: Callable[[Poses], Tensor]) -> "Siblings":
        """Siblings of one pose by ``symmetries`` (K, 4, 4), the identity first; ``measure`` gives features."""
        copies = pose[torch.zeros(len(symmetries), dtype=torch.long)]
        poses = placed(copies, copies.T @ symmetries.to(copies.T), describer.centre)
        views = F.normalize(describer.descriptors(poses.rotation, poses.distance), dim=1)
        return Siblings(poses, measure(poses), (views @ views.mT).double().cpu())

    @property
    def scores(self) -> Tensor:
        """(K,) scores."""
        return pose_scores(self.features, exact=True)

    def best(self) -> int:
        """Index of the sibling with the highest score; 0 unless it is clearly higher."""
        scores = self.scores
        best = int(scores.argmax())
        return best if float(scores[best] - scores[0]) > BETTER else 0

    def rival(self, best: int, fitted: Tensor) -> tuple[Poses, Tensor] | None:
        """The sibling with the highest score among those that look different from the ``best`` one, and its features
        (1, F): those of the best one as it was ``fitted`` (1, F), plus their difference without a fit. None if all look
        alike: they are one pose of a symmetric mesh."""
        weight = SCORE_WEIGHTS[POSE_FEATURES.index("similarity")]
        scores = self.scores
        behind = scores[best] - scores
        looks_different = weight * (1.0 - self.likeness[best]) > LOOKS_DIFFERENT
        angle = rotation_error(self.poses.T[:, :3, :3], self.poses.T[best, :3, :3])
        other = (looks_different | (behind > resolution(exact=True))) & (angle > RIVAL_ANGLE)
        if not bool(other.any()):
            return None
        chosen = torch.where(other, scores, -torch.inf).argmax()[None]
        return self.poses[chosen], fitted + self.features[chosen] - self.features[best]


def telling_symmetries(mesh: trimesh.Trimesh, symmetries: Tensor) -> Tensor:
    """(K, 4, 4) those of the symmetries (S, 4, 4) of a mesh's shape that a small feature tells from the identity, which
    is the first; at most ``MAX_SIBLINGS``, far from each other."""
    chosen = spread(symmetries)
    telling = feature_fractions(mesh, chosen) > FEATURE_FRACTION
    telling[0] = True
    return chosen[telling]


def spread(symmetries: Tensor) -> Tensor:
    """At most ``MAX_SIBLINGS`` of the symmetries (S, 4, 4), the identity first, far from each other."""
    R = symmetries[:, :3, :3].double()
    chosen = [0]
    nearest = rotation_error(R, R[0])
    while len(chosen) < min(MAX_SIBLINGS, len(R)):
        farthest = int(nearest.argmax())
        chosen.append(farthest)
        nearest = torch.minimum(nearest, rotation_error(R, R[farthest]))
    return symmetries[torch.tensor(chosen)]
