"""Hypotheses: the best distinct views of rankings, which later stages refine to poses."""

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from ..matching import Ranking, ViewBank, distinct_views

__all__ = ["Hypotheses", "distinct_mask", "start_hypotheses"]

SAME = 15.0
"""Degrees within which two hypotheses count as one."""


@dataclass(frozen=True)
class Hypotheses:
    """H candidate rotations of objects in photographs; those of one photograph are adjacent, best first.

    Attributes:
        image_index: (H,) int64, ascending.
        view: (H,) int64 view of the bank that the hypothesis started from.
        model: (H,) int64 mesh of the bank.
        rotation: (H, 3, 3) float64 allocentric rotations.
        distance: (H,) float64 of the object's centre, model units.
        ranking_score: (H,) float64 score S of ``view`` in the ranking.
        similarity: (H,) float64 normalised correlation with the photograph as the search measured it; NaN before.
    """

    image_index: Tensor
    view: Tensor
    model: Tensor
    rotation: Tensor
    distance: Tensor
    ranking_score: Tensor
    similarity: Tensor

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, index: Tensor) -> "Hypotheses":
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def by_model(self) -> list[tuple[int, Tensor]]:
        """Each model that occurs, and the indices of its hypotheses."""
        return [(m, (self.model == m).nonzero()[:, 0]) for m in self.model.unique().tolist()]


def start_hypotheses(ranking: Ranking, bank: ViewBank, *, count: int, symmetries: Tensor | None = None) -> Hypotheses:
    """At most ``count`` best distinct views of every photograph, see :func:`distinct_views`; on the CPU."""
    rotations, orders = bank.rotations, list(ranking.order)
    if ranking.allowed is not None:
        orders = [order[allowed[order]] for order, allowed in zip(orders, ranking.allowed, strict=True)]
    views = [distinct_views(o, rotations, count=count, symmetries=symmetries, model=bank.model) for o in orders]
    image_index = torch.tensor([b for b, chosen in enumerate(views) for _ in chosen], dtype=torch.long)
    view = torch.cat([torch.zeros(0, dtype=torch.long), *(chosen.cpu() for chosen in views)])
    score = ranking.scores.cpu()[image_index, view].double()
    return Hypotheses(
        image_index=image_index,
        view=view,
        model=bank.model.cpu()[view],
        rotation=rotations.cpu()[view].double(),
        distance=bank.distances.cpu()[view],
        ranking_score=score,
        similarity=torch.full_like(score, torch.nan),
    )


def distinct_mask(hypotheses: Hypotheses, score: Tensor, *, symmetries: Tensor | None = None) -> Tensor:
    """(H,) bool: False where a hypothesis is within ``SAME`` degrees of one with a higher ``score`` (H,)."""
    distinct = torch.zeros(len(hypotheses), dtype=torch.bool)
    order = score.argsort(descending=True, stable=True)
    for b in hypotheses.image_index.unique():
        mine = order[hypotheses.image_index[order] == b]
        R, model, best_first = hypotheses.rotation[mine].float(), hypotheses.model[mine], torch.arange(len(mine))
        chosen = distinct_views(best_first, R, count=len(mine), angle=SAME, symmetries=symmetries, model=model)
        distinct[mine[chosen]] = True
    return distinct
