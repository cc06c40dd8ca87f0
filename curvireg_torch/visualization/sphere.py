"""Scores of a ranking over the viewing directions."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import InvalidInputError
from ..matching import Ranking, ViewBank

__all__ = ["direction_scores", "sphere_map"]


def direction_scores(bank: ViewBank, ranking: Ranking, *, image_index: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Best score of every viewing direction of a bank, over in-plane rotations and distances.

    Returns:
        azimuth and elevation (M,) in degrees, [0, 360) and [-90, 90], and score (M,); float64.

    Raises:
        InvalidInputError: a ranking of other views, or no such photograph.
    """
    if ranking.scores.shape[1] != len(bank) or not 0 <= image_index < len(ranking):
        expected = f"{len(bank)} views and image {image_index}"
        raise InvalidInputError(f"ranking: expected {expected}, got {tuple(ranking.scores.shape)}")
    azimuth, elevation = bank.views.azimuth.cpu().double() % 360.0, bank.views.elevation.cpu().double()
    azimuth = torch.where(elevation.abs() > 89.999, 0.0, azimuth)  # at a pole azimuth is an in-plane rotation
    keys = torch.stack([azimuth, elevation], dim=1).mul(1000).round().long()
    group = keys.unique(dim=0, return_inverse=True)[1]
    count = int(group.max()) + 1
    score = torch.full((count,), -torch.inf, dtype=torch.float64)
    score = score.scatter_reduce(0, group, ranking.scores[image_index].cpu().double(), "amax")
    first = torch.full((count,), len(bank)).scatter_reduce(0, group, torch.arange(len(bank)), "amin")
    return azimuth[first], elevation[first], score


def sphere_map(
    azimuth: Tensor, elevation: Tensor, score: Tensor, *, size: tuple[int, int] = (180, 360)
) -> NDArray[np.float64]:
    """Map of scores of (M,) directions: rows from elevation 90 to -90, columns from azimuth 0 to 360.

    A cell has the score of the nearest direction, or NaN if that is farther away than any direction is from its
    nearest neighbour.

    Example:
        >>> sphere_map(torch.tensor([0.0, 180]), torch.zeros(2), torch.tensor([1.0, 2]), size=(1, 4)).tolist()
        [[1.0, 2.0, 2.0, 1.0]]
    """
    rows, columns = size
    e = 90.0 - (torch.arange(rows, dtype=torch.float64) + 0.5) * 180.0 / rows
    a = (torch.arange(columns, dtype=torch.float64) + 0.5) * 360.0 / columns
    directions = _unit(azimuth.double(), elevation.double())
    cells = _unit(a[None].expand(rows, columns), e[:, None].expand(rows, columns)).reshape(-1, 3)
    cosine, nearest = (cells @ directions.T).mul(1e9).round().div(1e9).max(dim=1)  # the first of equal ones
    neighbour = (directions @ directions.T).fill_diagonal_(-1.0).amax(dim=1).clamp(-1.0, 1.0)
    reach = torch.acos(neighbour).amax() if len(neighbour) > 1 else torch.tensor(torch.pi)
    is_near = torch.acos(cosine.clamp(-1.0, 1.0)) <= reach
    return np.asarray(torch.where(is_near, score.double()[nearest], torch.nan).view(rows, columns).numpy())


def _unit(azimuth: Tensor, elevation: Tensor) -> Tensor:
    a, e = torch.deg2rad(azimuth), torch.deg2rad(elevation)
    return torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], dim=-1)
