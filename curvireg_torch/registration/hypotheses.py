"""Hypotheses: the best distinct views of rankings, as poses in the making."""

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from ..matching import Ranking, ViewBank, distinct_views

__all__ = ["Hypotheses", "distinct_mask", "hypotheses"]

SAME = 15.0
"""Degrees within which two hypotheses have become one."""


@dataclass(frozen=True)
class Hypotheses:
    """H guesses at the poses of objects in photographs, several of a photograph, best first.

    Attributes:
        photograph: (H,) int64, ascending.
        view: (H,) int64 of the bank, where the guess comes from.
        model: (H,) int64 of the bank.
        rotation: (H, 3, 3) float64 allocentric rotations: of a camera that looks straight at the object.
        distance: (H,) float64 of the object's centre, model units.
        score: (H,) float64 similarity of view and photograph.
    """

    photograph: Tensor
    view: Tensor
    model: Tensor
    rotation: Tensor
    distance: Tensor
    score: Tensor

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, index: Tensor) -> "Hypotheses":
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})


def hypotheses(ranking: Ranking, bank: ViewBank, *, count: int, symmetries: Tensor | None = None) -> Hypotheses:
    """The best ``count`` distinct views of every photograph, see :func:`distinct_views`; on the CPU.

    Args:
        ranking: of the bank's views for B photographs.
        count: at most so many of each photograph.
        symmetries: of :func:`distinct_views`.
    """
    rotations = bank.rotations
    views = [distinct_views(o, rotations, count=count, symmetries=symmetries, model=bank.model) for o in ranking.order]
    photograph = torch.tensor([b for b, chosen in enumerate(views) for _ in chosen], dtype=torch.long)
    view = torch.cat([torch.zeros(0, dtype=torch.long), *(chosen.cpu() for chosen in views)])
    return Hypotheses(
        photograph=photograph,
        view=view,
        model=bank.model.cpu()[view],
        rotation=rotations.cpu()[view].double(),
        distance=bank.distances.cpu()[view],
        score=ranking.scores.cpu()[photograph, view].double(),
    )


def distinct_mask(found: Hypotheses, score: Tensor, *, symmetries: Tensor | None = None) -> Tensor:
    """(H,) bool: False where a hypothesis ended within ``SAME`` degrees of a better one of its photograph.

    Args:
        score: (H,) the higher the better.
        symmetries: of :func:`distinct_views`.
    """
    own = torch.zeros(len(found), dtype=torch.bool)
    order = score.argsort(descending=True, stable=True)
    for b in found.photograph.unique():
        mine = order[found.photograph[order] == b]
        R, model, best_first = found.rotation[mine].float(), found.model[mine], torch.arange(len(mine))
        apart = distinct_views(best_first, R, count=len(mine), angle=SAME, symmetries=symmetries, model=model)
        own[mine[apart]] = True
    return own
