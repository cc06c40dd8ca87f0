"""Siblings of a pose: what the symmetries of a mesh's shape make of it, compared where small
features differ."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..evidence import Evidence, EvidenceWeights
from ..fitting.details import compared, contour_details
from ..fitting.devices import on_device
from ..fitting.edges import EdgeCrops
from ..geometry.viewpoint import rotation_error
from .block import Block, fitted_poses
from .confidence import RIVAL_ANGLE
from .described import with_evidence
from .hypotheses import Hypotheses, placed
from .target import Target

BETTER = 0.1  # Score by which a sibling replaces the pose: more than rounding


@dataclass(frozen=True)
class Siblings:
    """K poses that symmetries of the shape make of one, the pose itself first.

    Attributes:
        poses: of them, with evidence that is measured in the same way for all, without a fit.
        details: (K, K) :func:`.compare_details` of the row with the column.
        look_different: (K, K) bool.
        weights: of evidence.
    """

    poses: Hypotheses
    details: Tensor
    look_different: Tensor
    weights: EvidenceWeights

    def gain(self, other: int) -> Tensor:
        """(K,) by how much siblings score more than the ``other`` one."""
        scores = self.poses.evidence.scores(self.weights)
        return scores - scores[other] + self.details[:, other]

    def best(self) -> int:
        """Index of the sibling with the highest score; 0 unless it is clearly higher."""
        gain = self.gain(0)
        best = int(gain.argmax())
        return best if float(gain[best]) > BETTER else 0

    def rival(self, best: int, fitted: Evidence, *, notable: bool) -> tuple[Hypotheses, bool]:
        """The sibling with the highest score among those that differ from the ``best`` one in the
        photograph, or in a ``notable`` feature of the mesh that it does not show; none if it is the
        same pose of a symmetric mesh. And whether a small feature of the mesh tells siblings apart
        that the photograph does not show.

        Its evidence is that of the best one as it was ``fitted``, plus their difference without a
        fit.
        """
        poses = self.poses
        angle = rotation_error(poses.T[:, :3, :3], poses.T[best, :3, :3])
        far = angle > RIVAL_ANGLE
        different = far & self.look_different[best]
        alike = far & ~self.look_different[best]
        counted = far if notable else different
        some = counted.nonzero()[:, 0]
        chosen = some[self.gain(best)[some].argsort(descending=True)[:1]]
        own = poses.evidence.table
        evidence = Evidence.from_table(fitted.table + own[chosen] - own[best])
        details = evidence.details + self.details[chosen, best]
        rival = replace(poses[chosen], evidence=replace(evidence, details=details))
        return rival, bool(alike.any())


def siblings_of(target: Target, block: Block, crops: EdgeCrops, best: Hypotheses) -> list[Siblings]:
    """The siblings of the ``best`` pose of each photograph, by the symmetries of the shape that
    small features tell apart, the identity first."""
    symmetries = target.telling_symmetries.transforms
    count = len(symmetries)
    copies = best[torch.arange(len(best)).repeat_interleave(count)]
    T = copies.T @ symmetries.to(copies.T).repeat(len(best), 1, 1)
    poses = placed(copies, T, target.describer.centre)
    given = poses.cameras, poses.T, poses.photograph
    seen = on_device(contour_details, target.describer.device_contours, crops, *given)
    poses = with_evidence(target, block, poses)
    weights = target.score_weights(exact=True)
    return [
        Siblings(poses[rows], *compared(seen[rows]), weights=weights)
        for rows in torch.arange(len(poses)).split(count)
    ]


def with_siblings(
    target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses
) -> tuple[Hypotheses, Hypotheses, list[bool]]:
    """Replace the best pose of each photograph by what a symmetry of the shape makes of it, if
    small features say so; return the poses, the strongest rival of each best one among these, and
    for each photograph whether it hides the feature. Given symmetries are trusted."""
    symmetries = target.telling_symmetries
    if len(symmetries) == 1:
        return poses, poses[:0], [False] * len(block)
    best = poses.best(target.score_weights(exact=True))
    siblings = siblings_of(target, block, crops, poses[best])
    kept = [one.best() for one in siblings]
    moved = torch.tensor([k for k, place in enumerate(kept) if place], dtype=torch.long)
    if len(moved):
        starts = Hypotheses.cat(
            [siblings[k].poses[torch.tensor([kept[k]])] for k in moved.tolist()]
        )
        fitted = fitted_poses(target, block, crops, starts, refit=True)
        fitted = with_evidence(target, block, fitted)
        allowed = block.keeps(fitted)
        poses = poses.with_poses(best[moved[allowed]], fitted[allowed])
    pairs = [
        one.rival(place, poses.evidence[row], notable=symmetries.notable)
        for one, place, row in zip(siblings, kept, best.split(1), strict=True)
    ]
    rivals = Hypotheses.cat([rival for rival, _ in pairs])
    rivals = replace(
        rivals,
        is_outside=torch.zeros_like(rivals.is_outside),
        is_distinct=torch.ones_like(rivals.is_distinct),
        is_sibling=torch.ones_like(rivals.is_sibling),
    )
    return poses, rivals[block.keeps(rivals)], [is_hidden for _, is_hidden in pairs]
