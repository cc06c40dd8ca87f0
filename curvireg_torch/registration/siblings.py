"""Siblings of a pose: what the symmetries of a mesh's shape make of it, compared where small
features differ."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..evidence import Evidence, EvidenceWeights
from ..fitting.edges import EdgeCrops
from ..fitting.together import details_together
from ..geometry.viewpoint import rotation_error
from ..matching import ViewDescriber
from .confidence import RIVAL_ANGLE
from .described import evidence_of
from .poses import Poses, placed, with_edge_support
from .refits import best_inside
from .target import Target
from .work import Work, fitted_poses, with_replaced

BETTER = 0.1  # Score by which a sibling replaces the pose: more than rounding


@dataclass(frozen=True)
class Siblings:
    """K poses that symmetries of the shape make of one, the pose itself first.

    Attributes:
        poses: of them.
        evidence: of them, all measured in the same way, without a fit.
        details: (K, K) :func:`.compare_details` of the row with the column.
        look_different: (K, K) bool.
        weights: of evidence.
    """

    poses: Poses
    evidence: Evidence
    details: Tensor
    look_different: Tensor
    weights: EvidenceWeights

    @staticmethod
    def of(
        pose: Poses,
        symmetries: Tensor,
        describer: ViewDescriber,
        crops: EdgeCrops,
        measure: Callable[[Poses], Evidence],
        weights: EvidenceWeights,
    ) -> "Siblings":
        """Siblings of one pose by ``symmetries`` (K, 4, 4), the identity first; ``measure`` gives
        evidence."""
        copies = pose[torch.zeros(len(symmetries), dtype=torch.long)]
        poses = placed(copies, copies.T @ symmetries.to(copies.T), describer.centre)
        details = details_together(
            describer.device_contours, crops, poses.cameras, poses.T, poses.crop_index
        )
        return Siblings(poses, measure(poses), *details, weights=weights)

    def gain(self, other: int) -> Tensor:
        """(K,) by how much siblings score more than the ``other`` one."""
        scores = self.evidence.scores(self.weights)
        return scores - scores[other] + self.details[:, other]

    def best(self) -> int:
        """Index of the sibling with the highest score; 0 unless it is clearly higher."""
        gain = self.gain(0)
        best = int(gain.argmax())
        return best if float(gain[best]) > BETTER else 0

    def rival(self, best: int, fitted: Evidence) -> tuple[Poses, Evidence] | None:
        """The sibling with the highest score among those that look different from the ``best`` one,
        and its evidence: that of the best one as it was ``fitted``, plus their difference without a
        fit. None if all look alike: they are one pose of a symmetric mesh."""
        angle = rotation_error(self.poses.T[:, :3, :3], self.poses.T[best, :3, :3])
        other = self.look_different[best] & (angle > RIVAL_ANGLE)
        if not bool(other.any()):
            return None
        chosen = torch.where(other, self.gain(best), -torch.inf).argmax()[None]
        gained = fitted.table + self.evidence[chosen].table - self.evidence[best].table
        evidence = Evidence.from_table(gained)
        details = evidence.details + self.details[chosen, best]
        return self.poses[chosen], replace(evidence, details=details)


def with_siblings(
    target: Target,
    work: Work,
    crops: EdgeCrops,
    poses: Poses,
    evidence: Evidence,
    outside: Tensor,
) -> tuple[Poses, Evidence, tuple[Poses, Evidence] | None]:
    """Replace the best pose by what a symmetry of the shape makes of it, if small features say so;
    and return its strongest rival among these, with its evidence, unless all of them look alike.
    Given symmetries are trusted."""
    symmetries = target.telling_symmetries
    if len(symmetries) == 1:
        return poses, evidence, None
    best = best_inside(target, evidence, outside)

    def measure(some: Poses) -> Evidence:
        return evidence_of(target, work, with_edge_support(target.describer, crops, some))

    weights = target.score_weights(exact=True)
    siblings = Siblings.of(poses[best], symmetries, target.describer, crops, measure, weights)
    kept = siblings.best()
    if kept:
        fitted = fitted_poses(target, work, crops, siblings.poses[torch.tensor([kept])], again=True)
        new = evidence_of(target, work, fitted)
        poses, evidence = with_replaced(work, poses, evidence, best, fitted, new)
    rival = siblings.rival(kept, evidence[best])
    if rival is not None and work.limits is not None and not bool(work.limits.keeps(rival[0])):
        rival = None
    return poses, evidence, rival
