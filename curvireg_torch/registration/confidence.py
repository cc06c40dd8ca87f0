"""How far a ranking can be trusted."""

import torch
from torch import Tensor

from ..geometry.viewpoint import rotation_error

__all__ = ["confidence", "distinct_views"]


def confidence(scores: Tensor, rotations: Tensor, *, angle: float = 30.0, sharpness: float = 4.0) -> Tensor:
    """Share of the score's mass that lies around the best view.

    The sum of scores^sharpness over the views within ``angle`` of the best, divided by that over all views. A ranking
    with one sharp peak tends to 1; one that cannot tell views apart tends to the share of views near any view. It says
    how clearly the views differ, not that the object is in the box.

    Args:
        scores: (B, N) in [0, 1].
        rotations: (N, 3, 3) of the views.
        angle: degrees.

    Returns:
        (B,) in [0, 1].

    Example:
        >>> R = torch.stack([torch.eye(3), torch.diag(torch.tensor([1.0, -1.0, -1.0]))])
        >>> confidence(torch.tensor([[1.0, 0.0], [1.0, 1.0]]), R).tolist()
        [1.0, 0.5]
    """
    best = rotations[scores.argmax(dim=1)]
    near = rotation_error(best[:, None], rotations[None]) <= angle
    weights = scores.double() ** sharpness
    return ((weights * near).sum(dim=1) / weights.sum(dim=1).clamp(min=1e-300)).float()


def distinct_views(order: Tensor, rotations: Tensor, *, count: int, angle: float = 30.0) -> Tensor:
    """Best views that are at least ``angle`` degrees from every better one: peaks, not ten neighbours of one.

    Args:
        order: (N,) view indices, best first.
        rotations: (N, 3, 3) of the views.

    Returns:
        (K,) view indices, best first, K <= count.
    """
    kept: list[int] = []
    open_views = torch.ones(len(rotations), dtype=torch.bool, device=order.device)
    while len(kept) < count:
        candidates = order[open_views[order]]
        if len(candidates) == 0:
            break
        kept.append(int(candidates[0]))
        open_views &= rotation_error(rotations[candidates[0]], rotations) > angle
    return torch.tensor(kept, dtype=torch.long, device=order.device)
