"""Siblings of a pose: what the symmetries of a mesh's shape make of it, compared where small
features differ."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import trimesh
from torch import Tensor

from ..fitting.details import compare_details
from ..fitting.edges import EdgeCrops
from ..geometry.viewpoint import rotation_error
from ..matching import ViewDescriber
from ..mesh.symmetry import FEATURE_FRACTION, feature_fractions
from .confidence import RIVAL_ANGLE
from .poses import POSE_FEATURES, Poses, placed, pose_scores, with_edge_support
from .refits import best_inside

if TYPE_CHECKING:
    from .judging import Work
    from .registrar import Registrar

# Symmetries that are compared, the identity among them: every 30 degrees of a body of revolution
MAX_SIBLINGS = 12
BETTER = 0.1  # Score by which a sibling replaces the pose: more than rounding


@dataclass(frozen=True)
class Siblings:
    """K poses that symmetries of the shape make of one, the pose itself first.

    Attributes:
        poses: of them.
        features: (K, F) :data:`.POSE_FEATURES`, all measured in the same way, without a fit.
        details: (K, K) :func:`.compare_details` of the row with the column.
        look_different: (K, K) bool.
    """

    poses: Poses
    features: Tensor
    details: Tensor
    look_different: Tensor

    @staticmethod
    def of(
        pose: Poses,
        symmetries: Tensor,
        describer: ViewDescriber,
        crops: EdgeCrops,
        measure: Callable[[Poses], Tensor],
    ) -> "Siblings":
        """Siblings of one pose by ``symmetries`` (K, 4, 4), the identity first; ``measure`` gives
        features."""
        copies = pose[torch.zeros(len(symmetries), dtype=torch.long)]
        poses = placed(copies, copies.T @ symmetries.to(copies.T), describer.centre)
        details = compare_details(
            describer.contours, crops, poses.cameras, poses.T, poses.crop_index
        )
        return Siblings(poses, measure(poses), *details)

    def gain(self, other: int) -> Tensor:
        """(K,) by how much siblings score more than the ``other`` one."""
        scores = pose_scores(self.features, exact=True)
        return scores - scores[other] + self.details[:, other]

    def best(self) -> int:
        """Index of the sibling with the highest score; 0 unless it is clearly higher."""
        gain = self.gain(0)
        best = int(gain.argmax())
        return best if float(gain[best]) > BETTER else 0

    def rival(self, best: int, fitted: Tensor) -> tuple[Poses, Tensor] | None:
        """The sibling with the highest score among those that look different from the ``best`` one,
        and its features (1, F): those of the best one as it was ``fitted`` (1, F), plus their
        difference without a fit. None if all look alike: they are one pose of a symmetric mesh."""
        angle = rotation_error(self.poses.T[:, :3, :3], self.poses.T[best, :3, :3])
        other = self.look_different[best] & (angle > RIVAL_ANGLE)
        if not bool(other.any()):
            return None
        chosen = torch.where(other, self.gain(best), -torch.inf).argmax()[None]
        features = fitted + self.features[chosen] - self.features[best]
        features[:, POSE_FEATURES.index("details")] += self.details[chosen, best]
        return self.poses[chosen], features


def telling_symmetries(mesh: trimesh.Trimesh, symmetries: Tensor) -> Tensor:
    """(K, 4, 4) those of the symmetries (S, 4, 4) of a mesh's shape that a small feature tells from
    the identity, which is the first; at most ``MAX_SIBLINGS``, far from each other."""
    chosen = spread(symmetries)
    telling = feature_fractions(mesh, chosen) > FEATURE_FRACTION
    telling[0] = True
    return chosen[telling]


def spread(symmetries: Tensor) -> Tensor:
    """At most ``MAX_SIBLINGS`` of the symmetries (S, 4, 4), the identity first, far from each
    other."""
    R = symmetries[:, :3, :3].double()
    chosen = [0]
    nearest = rotation_error(R, R[0])
    while len(chosen) < min(MAX_SIBLINGS, len(R)):
        farthest = int(nearest.argmax())
        chosen.append(farthest)
        nearest = torch.minimum(nearest, rotation_error(R, R[farthest]))
    return symmetries[torch.tensor(chosen)]


def with_siblings(
    registrar: "Registrar",
    work: "Work",
    crops: EdgeCrops,
    poses: Poses,
    features: Tensor,
    outside: Tensor,
) -> tuple[Poses, Tensor, tuple[Poses, Tensor] | None]:
    """Replace the best pose by what a symmetry of the shape makes of it, if small features say so;
    and return its strongest rival among these, with its features, unless all of them look alike.
    Given symmetries are trusted."""
    symmetries = registrar.telling_symmetries
    if len(symmetries) == 1:
        return poses, features, None
    best = best_inside(features, outside)

    def measure(some: Poses) -> Tensor:
        return registrar.features_of(work, with_edge_support(registrar.describer, crops, some))

    siblings = Siblings.of(poses[best], symmetries, registrar.describer, crops, measure)
    kept = siblings.best()
    if kept:
        fitted = registrar.fitted(work, crops, siblings.poses[torch.tensor([kept])], again=True)
        new = registrar.features_of(work, fitted)
        poses, features = registrar.replaced(work, poses, features, best, fitted, new)
    rival = siblings.rival(kept, features[best])
    if rival is not None and work.limits is not None and not bool(work.limits.keeps(rival[0])):
        rival = None
    return poses, features, rival
