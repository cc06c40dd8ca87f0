"""What speaks for a pose, by name, and how much each kind of evidence counts in its score."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields

import torch
from torch import Tensor

from .utils.checks import check_number
from .utils.rows import Rows

__all__ = ["Evidence", "EvidenceWeights"]


@dataclass(frozen=True)
class EvidenceWeights:
    """Weights of the kinds of :class:`Evidence` in the score of a pose, by the same names
    (docs/experiments.md).

    The rank does not count where poses are fitted: how near a view of the bank was to one is a
    matter of sampling. Nor does the edge support, which poses that predict few contours reach
    easily.

    Example:
        >>> EvidenceWeights(details=0.0).contours
        10.0
    """

    rank: float = 0.0
    similarity: float = 10.0
    edge_support: float = 0.0
    appearance: float = 2.5
    keypoints: float = 6.0
    details: float = 1.0
    contours: float = 10.0

    def __post_init__(self) -> None:
        for name, weight in vars(self).items():
            check_number(weight, name)

    @classmethod
    def only(cls, **weights: float) -> "EvidenceWeights":
        """Weights of some kinds, the others 0."""
        return cls(**{**dict.fromkeys((field.name for field in fields(cls)), 0.0), **weights})


RANK_ALONE = EvidenceWeights.only(rank=1.0)
"""Weights with the mesh of a similar object: poses keep the order of the ranking."""


@dataclass(frozen=True)
class Evidence(Rows):
    """What speaks for H poses, or for each of them in V photographs: float64, (H,) or (V, H).
    Hypotheses report it under these names.

    A new kind of evidence is a field here, its measure in :meth:`measured`, and its weight in
    :class:`EvidenceWeights`.

    Attributes:
        rank: log S of the view that a pose started from, minus that of the best view.
        similarity: normalised correlation of the pose's view with the photograph.
        edge_support: of the fitted pose; 0 without the contour fit.
        appearance: log appearance score of the pose; 0 without that term.
        keypoints: log (1 + n) with the number n of keypoints that agree with the pose, beyond those
            that agree by chance; 0 without colours, camera or contour fit, with a similar mesh, and
            where a given pose is refined.
        details: by how much the contours that only this pose or only the best one predicts speak
            for it, see ``compare_details``; 0 for poses that score far less than the best.
        contours: by how much the edges under its contours exceed chance, see
            ``edge_excess``; 0 without the contour fit.

    Example:
        >>> from dataclasses import replace
        >>> similarity = torch.tensor([0.75, 0.5], dtype=torch.float64)
        >>> evidence = replace(Evidence.zeros(2), similarity=similarity)
        >>> evidence.named(0)["similarity"], evidence.scores(EvidenceWeights()).tolist()
        (0.75, [7.5, 5.0])
    """

    rank: Tensor
    similarity: Tensor
    edge_support: Tensor
    appearance: Tensor
    keypoints: Tensor
    details: Tensor
    contours: Tensor

    @classmethod
    def measured(
        cls,
        *,
        rank: Tensor,
        similarity: Tensor,
        edge_support: Tensor,
        appearance: Tensor,
        keypoints: Tensor,
        contours: Tensor,
    ) -> "Evidence":
        """The evidence of poses beside a photograph, without details, from measures (H,) of them:
        the edge support may be NaN, ``keypoints`` is the number of those that agree, beyond those
        that agree by chance."""
        return cls(
            rank=rank,
            similarity=similarity,
            edge_support=edge_support.nan_to_num(0.0),
            appearance=appearance.double(),
            keypoints=keypoints.log1p(),
            details=torch.zeros_like(similarity),
            contours=contours,
        )

    @classmethod
    def zeros(cls, count: int) -> "Evidence":
        """``count`` poses for which nothing speaks."""
        nothing = torch.zeros(count, dtype=torch.float64)
        return cls(**{field.name: nothing for field in fields(cls)})

    @classmethod
    def of_hypotheses(cls, reported: Sequence[Mapping[str, float]]) -> "Evidence":
        """The evidence that hypotheses report."""
        names = [field.name for field in fields(cls)]
        return cls.from_table(
            torch.tensor([[one[name] for name in names] for one in reported], dtype=torch.float64)
        )

    @property
    def table(self) -> Tensor:
        """(..., F) all kinds, in the order of the fields."""
        return torch.stack(list(self.columns().values()), dim=-1)

    @classmethod
    def from_table(cls, table: Tensor) -> "Evidence":
        """The inverse of :attr:`table`."""
        return cls(*table.unbind(-1))

    def mean(self, weights: Tensor) -> "Evidence":
        """(H,) weighted mean of (V, H) over photographs with weights (V,)."""
        shares = weights / weights.sum()
        return self.from_table(torch.einsum("v,vhk->hk", shares, self.table))

    def scores(self, weights: EvidenceWeights) -> Tensor:
        """(...) weighted sums, which order poses."""
        table = self.table
        return table @ torch.tensor(astuple(weights), dtype=table.dtype)

    def named(self, h: int) -> dict[str, float]:
        """The evidence of pose ``h`` by name, as a hypothesis reports it."""
        return dict(zip(self.columns(), self.table[h].tolist(), strict=True))
