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
from .candidates import Candidates
from .confidence import RIVAL_ANGLE
from .described import evidence_of
from .poses import Poses, placed
from .target import Target
from .work import Work, fitted_poses

BETTER = 0.1  # Score by which a sibling replaces the pose: more than rounding


@dataclass(frozen=True)
class Rival:
    """The strongest rival of the best pose among its siblings.

    Attributes:
        found: of it, one; none if it is the same pose of a symmetric mesh.
        feature_is_hidden: whether a small feature of the mesh tells the siblings apart, and the
            photograph does not show it.
    """

    found: Candidates
    feature_is_hidden: bool = False


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

    def rival(self, best: int, fitted: Evidence, *, notable: bool) -> Rival:
        """The sibling with the highest score among those that differ from the ``best`` one in the
        photograph, or in a ``notable`` feature of the mesh that it does not show.

        Its evidence is that of the best one as it was ``fitted``, plus their difference without a
        fit.
        """
        angle = rotation_error(self.poses.T[:, :3, :3], self.poses.T[best, :3, :3])
        far = angle > RIVAL_ANGLE
        different = far & self.look_different[best]
        alike = far & ~self.look_different[best]
        counted = far if notable else different
        some = counted.nonzero()[:, 0]
        chosen = some[self.gain(best)[some].argsort(descending=True)[:1]]
        gained = fitted.table + self.evidence[chosen].table - self.evidence[best].table
        evidence = Evidence.from_table(gained)
        details = evidence.details + self.details[chosen, best]
        evidence = replace(evidence, details=details)
        return Rival(Candidates.of(self.poses[chosen], evidence), bool(alike.any()))


def with_siblings(
    target: Target, work: Work, crops: EdgeCrops, found: Candidates
) -> tuple[Candidates, Rival]:
    """Replace the best pose by what a symmetry of the shape makes of it, if small features say so;
    and return its strongest rival among these. Given symmetries are trusted."""
    symmetries = target.telling_symmetries
    if len(symmetries) == 1:
        return found, Rival(found[:0])
    weights = target.score_weights(exact=True)
    best = found.best(weights)

    def measure(some: Poses) -> Evidence:
        return evidence_of(target, work, some)

    siblings = Siblings.of(
        found.poses[best], symmetries.transforms, target.describer, crops, measure, weights
    )
    kept = siblings.best()
    if kept:
        fitted = fitted_poses(target, work, crops, siblings.poses[torch.tensor([kept])], refit=True)
        new = evidence_of(target, work, fitted)
        found = found.with_fitted(best, fitted, new, work.limits)
    rival = siblings.rival(kept, found.evidence[best], notable=symmetries.notable)
    if work.limits is not None:
        allowed = work.limits.keeps(rival.found.poses)
        rival = replace(rival, found=rival.found[allowed])
    return found, rival
