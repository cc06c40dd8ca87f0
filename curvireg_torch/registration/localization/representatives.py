"""A few views that stand for all of a bank."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ...errors import InvalidInputError
from ...matching import ViewBank

__all__ = ["representative_views"]

SAMPLE = 1500
"""Views of a model that are looked at, evenly spread over the bank; all distances between them are in memory."""

ROUNDS = 10


def representative_views(bank: ViewBank, count: int) -> Tensor:
    """K-medoids of each model's views: which ``count`` views are the others most alike?

    Views differ by the squared distance of their descriptors, scaled to unit length, plus that of the logarithms of
    their boxes' proportions. The farthest views from each other start; every view then goes to its nearest medoid, and
    the view with the least total difference becomes the medoid of each group, until nothing moves.

    Args:
        bank: of one or several models.
        count: of each model, or all views of a smaller bank.

    Returns:
        (K,) ascending indices of the bank's views, on the CPU.

    Raises:
        InvalidInputError: ``count`` < 1.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45, elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> len(representative_views(bank, 3))
        3
    """
    if count < 1:
        raise InvalidInputError(f"count: expected >= 1, got {count}")
    sides = bank.boxes[:, 2:] - bank.boxes[:, :2]
    shapes = (sides[:, :1] / sides[:, 1:]).log().float()
    chosen = []
    for model in bank.model.unique():
        views = (bank.model == model).nonzero()[:, 0]
        if len(views) > SAMPLE:
            views = views[torch.arange(SAMPLE, device=views.device) * len(views) // SAMPLE]
        features = torch.cat([F.normalize(bank.descriptors[views].float(), dim=1), shapes[views]], dim=1)
        chosen.append(views[_medoids(torch.cdist(features, features).square(), count)])
    return torch.cat(chosen).cpu().sort().values


def _medoids(apart: Tensor, count: int) -> Tensor:
    """(min(count, N),) of (N, N) differences."""
    medoids = apart.sum(dim=1).argmin()[None]
    nearest = apart[medoids[0]]
    while len(medoids) < min(count, len(apart)):
        medoids = torch.cat([medoids, nearest.argmax()[None]])
        nearest = torch.minimum(nearest, apart[medoids[-1]])
    for _ in range(ROUNDS):
        group = F.one_hot(apart[:, medoids].argmin(dim=1), len(medoids)).to(apart)
        total = (apart @ group).masked_fill(group == 0, torch.inf)
        better = torch.where(group.any(dim=0), total.argmin(dim=0), medoids)
        if torch.equal(better, medoids):
            break
        medoids = better
    return medoids
