"""Repeatability of feature points between a photograph and every view, as one matrix product."""

import functools
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_masks, check_option, check_positive
from ..utils.threads import map_on_threads
from .base import Term, Views
from .query import QueryFeatures

__all__ = ["Repeatability", "dilate_points", "repeatability", "repeatability_score"]

MODES = ("monotone", "paper")

CHUNK = 64
"""Views whose points are unpacked or compared at a time."""


def dilate_points(points: Tensor, eps: float) -> Tensor:
    """Pixels within ``eps`` >= 0 px (Euclidean) of a point: (N, H, W) bool -> (N, H, W) bool."""
    check_masks(points, "points")
    check_positive(eps, "eps", zero_ok=True)
    radius = int(eps)
    if radius == 0:
        return points
    offsets = np.arange(-radius, radius + 1)
    disc = (offsets[:, None] ** 2 + offsets**2 <= eps**2).astype(np.uint8)
    planes = points.cpu().numpy().view(np.uint8)
    dilated = np.stack([cv2.dilate(plane, disc) for plane in planes]) if len(planes) else planes
    return torch.from_numpy(dilated.view(bool)).to(points.device)


def repeatability(query_points: Tensor, dilated_view_points: Tensor) -> Tensor:
    """(B, N) fraction of each query's points that have a view's point within eps (the paper's Rep, view -> query).

    It is 0 for a query without points.

    Args:
        query_points: (B, H, W) bool, or the number of points in each cell.
        dilated_view_points: (N, H, W) bool, from :func:`dilate_points`, or the fraction of each cell within eps.

    Example:
        >>> query = torch.zeros(1, 8, 8, dtype=torch.bool); query[0, 2, 2] = query[0, 6, 6] = True
        >>> view = torch.zeros(1, 8, 8, dtype=torch.bool); view[0, 2, 3] = True
        >>> repeatability(query, dilate_points(view, 1)).tolist()
        [[0.5]]
    """
    if query_points.shape[1:] != dilated_view_points.shape[1:]:
        raise InvalidInputError(
            f"query_points: expected shape (B, {', '.join(map(str, dilated_view_points.shape[1:]))}), "
            f"got {tuple(query_points.shape)}"
        )
    queries = query_points.flatten(1).float()
    return _fraction(_products(queries, dilated_view_points.flatten(1)), queries)


def repeatability_score(rep: Tensor, *, mode: str = "monotone", sigma: float = 0.1) -> Tensor:
    r"""S_rep in (0, 1] from repeatabilities, per query, with :math:`R = 1 - Rep`.

    - ``"monotone"``: :math:`\exp(-(R - \min R)^2 / (2\sigma^2))`: the most repeatable view scores 1;
    - ``"paper"``: :math:`\exp(-(R - \mathrm{mean} R)^2 / (2\sigma^2))`, which favours average views.

    ``rep`` is (B, N) in [0, 1]; ``sigma`` is the paper's :math:`\sigma_r`.

    Example:
        >>> repeatability_score(torch.tensor([[0.5, 0.4]]))[0].tolist()[0]
        1.0
    """
    return torch.exp(_log_score(rep, mode, sigma))


def _log_score(rep: Tensor, mode: str, sigma: float) -> Tensor:
    check_option(mode, MODES, "mode")
    check_positive(sigma, "sigma")
    R = 1.0 - rep
    centre = R.amin(dim=1, keepdim=True) if mode == "monotone" else R.mean(dim=1, keepdim=True)
    return -(R - centre).square() / (2.0 * sigma**2)


@dataclass(frozen=True)
class Repeatability(Term):
    """S_rep: the photograph's feature points have points of the view nearby, the best over the jittered crops.

    Attributes:
        sigma, mode: of :func:`repeatability_score`.
        eps: largest distance of matching points, as a fraction of the crop's side.
    """

    name: ClassVar[str] = "repeatability"
    sigma: float = 0.1
    mode: str = "monotone"
    eps: float = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self.sigma, "sigma")
        check_option(self.mode, MODES, "mode")
        check_positive(self.eps, "eps", zero_ok=True)

    def build(self, views: Views) -> nn.Module:
        return _RepeatabilityModule(views, self.eps)

    def log_score(self, raw: Tensor) -> Tensor:
        return _log_score(raw, self.mode, self.sigma)


def cell_counts(points: Tensor, cell: int) -> Tensor:
    """(N, C, C) number of set pixels of (N, S, S) bool in cells of ``cell`` px, the last of which may be cut.

    The integers have 8 bits if that suffices for a cell, else 16.
    """
    over = -points.shape[-1] % cell
    count = F.pad(points.view(torch.uint8), (0, over, 0, over))
    count = count if cell**2 < 256 else count.short()
    for dim in (1, 2):  # rows first: they are contiguous
        count = functools.reduce(torch.add, count.unfold(dim, cell, cell).unbind(dim=3))
    return count


class _RepeatabilityModule(nn.Module):
    """``near`` (N, cells) counts the pixels of each cell within eps of a view's points, ``area`` (1, cells) all."""

    near: Tensor
    area: Tensor

    def __init__(self, views: Views, eps: float) -> None:
        super().__init__()
        S = views.settings.image_size
        # Cells of at most eps px keep the matrix product small.
        self.cell = max(1, min(int(eps * S), S // 64))

        def count(i: int) -> Tensor:
            return cell_counts(dilate_points(views.points_at(slice(i, i + CHUNK)), eps * S), self.cell).flatten(1)

        near = map_on_threads(count, range(0, len(views), CHUNK), device=views.descriptors.device)
        whole = torch.ones(1, S, S, dtype=torch.bool, device=near[0].device)
        self.register_buffer("near", torch.cat(near), persistent=False)
        self.register_buffer("area", cell_counts(whole, self.cell).flatten(1), persistent=False)

    def forward(self, query: QueryFeatures) -> Tensor:
        B, K = query.points.shape[:2]
        # A point in a cut cell counts as much as any other.
        points = cell_counts(query.points.flatten(0, 1), self.cell).flatten(1).float()
        matched = _products(points / self.area, self.near)
        return _fraction(matched, points).view(B, K, len(self.near)).amax(dim=1)


def _products(queries: Tensor, views: Tensor) -> Tensor:
    """(B, N) inner products of float32 (B, D) with (N, D) of any type, which are converted a few at a time."""
    return torch.cat([queries @ few.float().T for few in views.split(CHUNK)], dim=1)


def _fraction(matched: Tensor, points: Tensor) -> Tensor:
    return matched / points.sum(dim=1, keepdim=True).clamp(min=torch.finfo(torch.float32).tiny)
