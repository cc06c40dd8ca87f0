"""A few views that represent a bank."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ...errors import InvalidInputError
from ...matching import ViewBank

__all__ = ["nearest_representatives", "representative_views"]

SAMPLE = 1500
"""Largest number of views of a model, evenly spread over the bank, whose pairwise distances are computed."""

ROUNDS = 10


def representative_views(bank: ViewBank, count: int) -> Tensor:
    """K-medoids of each model's views.

    The distance of two views is the squared distance of their unit descriptors plus that of the logarithms of their
    boxes' aspect ratios. The first medoid is the most central view, each further one the farthest from those before;
    views are then assigned to their nearest medoid, and medoids recomputed, until nothing changes.

    Args:
        bank: of one or several models.
        count: of each model; a smaller bank returns all its views.

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
    chosen = []
    for model in bank.model.unique():
        views = (bank.model == model).nonzero()[:, 0]
        if len(views) > SAMPLE:
            views = views[torch.arange(SAMPLE, device=views.device) * len(views) // SAMPLE]
        features = _features(bank, views)
        chosen.append(views[_medoids(torch.cdist(features, features).square(), count)])
    return torch.cat(chosen).cpu().sort().values


def nearest_representatives(bank: ViewBank, chosen: Tensor) -> Tensor:
    """(N,) index into ``chosen``, views of all models, of the most similar one of each view's model; on the CPU."""
    nearest = torch.zeros(len(bank), dtype=torch.long)
    for model in bank.model.unique():
        mine, views = (bank.model == model).nonzero()[:, 0].cpu(), (bank.model.cpu()[chosen] == model).nonzero()[:, 0]
        distances = torch.cdist(_features(bank, mine), _features(bank, chosen[views]))
        nearest[mine] = views[distances.argmin(dim=1).cpu()]
    return nearest


def _features(bank: ViewBank, views: Tensor) -> Tensor:
    sides = (bank.boxes[:, 2:] - bank.boxes[:, :2])[views]
    ratios = (sides[:, :1] / sides[:, 1:]).log().float()
    return torch.cat([F.normalize(bank.descriptors[views].float(), dim=1), ratios.to(bank.descriptors.device)], dim=1)


def _medoids(distances: Tensor, count: int) -> Tensor:
    """(min(count, N),) indices for (N, N) distances."""
    medoids = distances.sum(dim=1).argmin()[None]
    nearest = distances[medoids[0]]
    while len(medoids) < min(count, len(distances)):
        medoids = torch.cat([medoids, nearest.argmax()[None]])
        nearest = torch.minimum(nearest, distances[medoids[-1]])
    for _ in range(ROUNDS):
        group = F.one_hot(distances[:, medoids].argmin(dim=1), len(medoids)).to(distances)
        total = (distances @ group).masked_fill(group == 0, torch.inf)
        better = torch.where(group.any(dim=0), total.argmin(dim=0), medoids)
        if torch.equal(better, medoids):
            break
        medoids = better
    return medoids
