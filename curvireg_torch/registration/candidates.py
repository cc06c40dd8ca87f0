"""The fitted poses that compete for one photograph, with the evidence for each."""

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from ..evidence import Evidence, EvidenceWeights
from ..utils.rows import Rows
from .poses import Poses
from .priors import Limits


@dataclass(frozen=True)
class Candidates(Rows):
    """H poses that compete for a photograph.

    Attributes:
        poses: of them.
        evidence: of them.
        outside: (H,) bool, those that lie outside the limits of the photograph and are not
            reported.
        distinct: (H,) bool, False of poses that merged with a better one.
    """

    poses: Poses
    evidence: Evidence
    outside: Tensor
    distinct: Tensor

    @classmethod
    def of(cls, poses: Poses, evidence: Evidence, outside: Tensor | None = None) -> Self:
        """Distinct poses, by default all inside the limits."""
        nothing = torch.zeros(len(poses), dtype=torch.bool)
        return cls(poses, evidence, nothing if outside is None else outside, ~nothing)

    def scores(self, weights: EvidenceWeights) -> Tensor:
        """(H,) weighted sums of the evidence, -inf for poses outside the limits and merged ones."""
        excluded = self.outside | ~self.distinct
        return self.evidence.scores(weights).masked_fill(excluded, -torch.inf)

    def best(self, weights: EvidenceWeights) -> Tensor:
        """(1,) index of the highest of the :meth:`scores`."""
        return self.scores(weights).argmax()[None]

    def with_fitted(
        self, index: Tensor, poses: Poses, evidence: Evidence, limits: Limits | None = None
    ) -> Self:
        """Put fitted ``poses`` with their ``evidence`` in the places ``index``, unless that exceeds
        the limits."""
        if limits is not None and not bool(limits.keeps(poses)):
            return self
        return replace(
            self,
            poses=self.poses.replaced(index, poses),
            evidence=self.evidence.replaced(index, evidence),
        )
