"""Scores of all views for a batch of photographs, and the selection of distinct views."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..utils.checks import check_symmetries

__all__ = ["Ranking", "distinct_views"]


@dataclass(frozen=True)
class Ranking:
    """Scores of N views for B photographs.

    Attributes:
        scores: (B, N) in [0, 1], the product of the terms' scores, each to the power of its weight.
        order: (B, N) view indices, best first; ties in the order of the bank.
        terms: name -> (B, N) raw scores of each term: "hog": normalised correlation of descriptors, in [0, 1], or in
            [-1, 1] if they are whitened; "repeatability": fraction of the photograph's points found in the view; "box":
            S_box in [0, 1], similarity of the boxes' aspect ratios, best view 1.
        allowed: (B, N) bool, which views a pose prior leaves; None without one.
        outside: (B,) best of the other views more than 30 degrees from the best view, -1 if there are none; None
            without a prior.
    """

    scores: Tensor
    order: Tensor
    terms: Mapping[str, Tensor]
    allowed: Tensor | None = None
    outside: Tensor | None = None

    @staticmethod
    def none() -> "Ranking":
        """That of a photograph which was compared with no view."""
        return Ranking(torch.zeros(1, 0), torch.zeros(1, 0, dtype=torch.long), {})

    def __len__(self) -> int:
        return self.scores.shape[0]

    def __getitem__(self, index: slice) -> "Ranking":
        """Rankings of some photographs, as copies that do not keep the batch in memory."""
        terms = {name: raw[index].clone() for name, raw in self.terms.items()}
        allowed = None if self.allowed is None else self.allowed[index].clone()
        outside = None if self.outside is None else self.outside[index].clone()
        return Ranking(self.scores[index].clone(), self.order[index].clone(), terms, allowed, outside)

    @property
    def hog(self) -> Tensor:
        """``terms["hog"]``."""
        return self.terms["hog"]

    @property
    def repeatability(self) -> Tensor:
        """``terms["repeatability"]``."""
        return self.terms["repeatability"]

    @property
    def box(self) -> Tensor:
        """``terms["box"]``."""
        return self.terms["box"]

    def top(self, k: int) -> Tensor:
        """(B, k) indices of the best views; fewer if the bank is smaller."""
        return self.order[:, :k]

    @staticmethod
    def cat(parts: Sequence["Ranking"]) -> "Ranking":
        """Concatenate rankings of the same views."""
        terms = {name: torch.cat([part.terms[name] for part in parts]) for name in parts[0].terms}
        allowed = [p.allowed for p in parts if p.allowed is not None]
        outside = [p.outside for p in parts if p.outside is not None]
        return Ranking(
            torch.cat([p.scores for p in parts]),
            torch.cat([p.order for p in parts]),
            terms,
            torch.cat(allowed) if allowed else None,
            torch.cat(outside) if outside else None,
        )


def distinct_views(
    order: Tensor,
    rotations: Tensor,
    *,
    count: int,
    angle: float = 30.0,
    symmetries: Tensor | None = None,
) -> Tensor:
    """Best views that are more than ``angle`` degrees from every better selected one.

    Args:
        order: (N,) view indices, best first.
        rotations: (N, 3, 3) of the views.
        symmetries: (S, 3, 3) or (S, 4, 4) of the model, from :func:`curvireg_torch.geometry.symmetry_transforms`: views
            that differ by one of them count as the same.

    Returns:
        (K,) view indices, best first, K <= count.

    Example:
        >>> R = torch.stack([torch.eye(3), torch.diag(torch.tensor([-1.0, -1.0, 1.0]))])     # 180 degrees about z
        >>> distinct_views(torch.tensor([1, 0]), R, count=2, symmetries=R).tolist()
        [1]
    """
    symmetries = torch.eye(3)[None] if symmetries is None else symmetries
    check_symmetries(symmetries)
    symmetries = symmetries[:, :3, :3].to(rotations)
    selected: list[int] = []
    available = torch.ones(len(rotations), dtype=torch.bool, device=order.device)
    while len(selected) < count and len(candidates := order[available[order]]):
        best = int(candidates[0])
        selected.append(best)
        equivalent = rotations[best] @ symmetries
        traces = (equivalent.flatten(1) @ rotations.flatten(1).T).amax(dim=0)
        near = torch.rad2deg(torch.acos((0.5 * (traces - 1.0)).clamp(-1.0, 1.0))) <= angle
        available &= ~near
        available[best] = False
    return torch.tensor(selected, dtype=torch.long, device=order.device)
