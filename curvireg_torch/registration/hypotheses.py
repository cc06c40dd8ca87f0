"""Hypotheses: the best distinct views of rankings, as poses in the making."""

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from ..matching import Ranking, ViewBank

__all__ = ["Hypotheses", "distinct_views", "hypotheses"]


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


def distinct_views(
    order: Tensor,
    rotations: Tensor,
    *,
    count: int,
    angle: float = 30.0,
    symmetries: Tensor | None = None,
    model: Tensor | None = None,
) -> Tensor:
    """Best views that are more than ``angle`` degrees from every better one: peaks, not ten neighbours of one.

    Args:
        order: (N,) view indices, best first.
        rotations: (N, 3, 3) of the views.
        symmetries: (S, 3, 3) or (S, 4, 4) of the model, from :func:`curvireg_torch.geometry.symmetry_transforms`: views
            that differ by one of them count as the same.
        model: (N,) which model the views show: views of two models are always distinct.

    Returns:
        (K,) view indices, best first, K <= count.

    Example:
        >>> R = torch.stack([torch.eye(3), torch.diag(torch.tensor([-1.0, -1.0, 1.0]))])     # half a turn about z
        >>> distinct_views(torch.tensor([1, 0]), R, count=2, symmetries=R).tolist()
        [1]
    """
    turns = torch.eye(3)[None] if symmetries is None else symmetries[:, :3, :3]
    turns = turns.to(rotations)
    kept: list[int] = []
    open_views = torch.ones(len(rotations), dtype=torch.bool, device=order.device)
    while len(kept) < count:
        candidates = order[open_views[order]]
        if len(candidates) == 0:
            break
        best = int(candidates[0])
        kept.append(best)
        alike = rotations[best] @ turns
        traces = (alike.flatten(1) @ rotations.flatten(1).T).amax(dim=0)
        near = torch.rad2deg(torch.acos((0.5 * (traces - 1.0)).clamp(-1.0, 1.0))) <= angle
        open_views &= ~near if model is None else ~(near & (model == model[best]))
        open_views[best] = False
    return torch.tensor(kept, dtype=torch.long, device=order.device)
