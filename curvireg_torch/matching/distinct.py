"""Views that are far apart: peaks of a ranking, not ten neighbours of one."""

import torch
from torch import Tensor

from ..utils.checks import check_symmetries

__all__ = ["distinct_views"]


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
    if symmetries is None:
        symmetries = torch.eye(3)[None]
    else:
        check_symmetries(symmetries)
    turns = symmetries[:, :3, :3].to(rotations)
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
