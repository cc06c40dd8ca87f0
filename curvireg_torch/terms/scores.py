"""How well photographs agree with views, as functions of tensors: descriptors, feature points, box shapes."""

import functools
from collections.abc import Sequence

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_masks, check_option, check_positive, check_tensor

__all__ = [
    "Whitening",
    "box_shape_score",
    "box_shapes",
    "cell_counts",
    "dilate_points",
    "ledoit_wolf",
    "normalized_correlation",
    "repeatability",
    "repeatability_score",
    "unit_score",
    "whole_box_shapes",
]

REPEATABILITY_MODES = ("monotone", "paper")

BORDER_DISTANCE = 0.01
"""A box edge this close to the image's border, as a fraction of the box's longer side plus 1 px, counts as cut off."""

VIEWS_AT_A_TIME = 64
"""Views whose points are compared at a time."""


def normalized_correlation(queries: Tensor, views: Tensor) -> Tensor:
    """(B, N) cosines of (B, D) queries with (N, D) views; a zero descriptor scores 0.

    Example:
        >>> normalized_correlation(torch.tensor([[1.0, 0.0]]), torch.tensor([[2.0, 0.0], [0.0, 3.0]])).tolist()
        [[1.0, 0.0]]
    """
    check_tensor(queries, "queries", (None, None))
    check_tensor(views, "views", (None, queries.shape[1]))
    return F.normalize(queries, dim=1) @ F.normalize(views, dim=1).T


def unit_score(similarity: Tensor) -> Tensor:
    """Map (B, N) similarities to (0, 1] per query, best view 1: ``exp((s - max s) / std s)``, a softmax of z-scores.

    Example:
        >>> unit_score(torch.tensor([[1.0, 1.0, 1.0]])).tolist()
        [[1.0, 1.0, 1.0]]
    """
    return torch.exp(log_unit_score(similarity))


def log_unit_score(similarity: Tensor) -> Tensor:
    check_tensor(similarity, "similarity", (None, None))
    spread = (similarity - similarity.mean(dim=1, keepdim=True)).square().mean(dim=1, keepdim=True).sqrt()
    spread = torch.where(spread > 0, spread, torch.ones_like(spread))
    return (similarity - similarity.amax(dim=1, keepdim=True)) / spread


class Whitening(nn.Module):
    r"""x -> L^-1 (x - mean), where Sigma = L L^T: inner products become :math:`(x - \mu)^T \Sigma^{-1} (y - \mu)`.

    ``mean`` is (D,), ``covariance`` (D, D), symmetric, positive definite.

    Example:
        >>> whiten = Whitening(torch.zeros(2), torch.diag(torch.tensor([4.0, 1.0])))
        >>> whiten(torch.tensor([[2.0, 3.0]])).tolist()
        [[1.0, 3.0]]
    """

    def __init__(self, mean: Tensor, covariance: Tensor) -> None:
        super().__init__()
        check_tensor(mean, "mean", (None,))
        check_tensor(covariance, "covariance", (len(mean), len(mean)))
        factor, failed = torch.linalg.cholesky_ex(covariance.double())
        if int(failed):
            raise InvalidInputError("covariance: expected a positive definite matrix; shrink it")
        identity = torch.eye(len(mean), dtype=torch.float64, device=mean.device)
        self.mean: Tensor
        self.matrix: Tensor
        self.register_buffer("mean", mean.float())
        self.register_buffer("matrix", torch.linalg.solve_triangular(factor, identity, upper=False).float())

    def forward(self, descriptors: Tensor) -> Tensor:
        """(N, D) -> (N, D)."""
        check_tensor(descriptors, "descriptors", (None, len(self.mean)))
        return (descriptors.to(self.mean) - self.mean) @ self.matrix.T


def ledoit_wolf(descriptors: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (D,) and shrunk covariance (D, D) of (N, D) descriptors, N >= 2, float32.

    The covariance is (1 - a) S + a tr(S)/D Id with the a of Ledoit and Wolf (2004) that estimates the population's
    covariance best from the sample's covariance S.

    Example:
        >>> mean, covariance = ledoit_wolf(torch.rand(50, 8))
        >>> Whitening(mean, covariance)(torch.rand(3, 8)).shape
        torch.Size([3, 8])
    """
    check_tensor(descriptors, "descriptors", (None, None))
    count = len(descriptors)
    if count < 2:
        raise InvalidInputError(f"descriptors: expected at least 2, got {count}")
    x = descriptors.float()
    mean = x.mean(dim=0)
    x = x - mean
    fourth = float(x.square().sum(dim=1).double().square().mean())
    S = x.T @ x / count
    square = float(S.double().square().sum())
    spread = square - float(S.double().trace()) ** 2 / len(S)  # squared distance of S from its multiple of the identity
    a = min(1.0, max(0.0, (fourth - square) / count / spread)) if spread > 0 else 1.0
    ridge = a * float(S.diagonal().mean()) * torch.eye(len(S), dtype=S.dtype, device=S.device)
    return mean, (1.0 - a) * S + ridge


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
    return matched_fraction(inner_products(queries, dilated_view_points.flatten(1)), queries)


def repeatability_score(rep: Tensor, *, mode: str = "monotone", sigma: float = 0.1) -> Tensor:
    r"""S_rep in (0, 1] from repeatabilities, per query, with :math:`R = 1 - Rep`.

    - ``"monotone"``: :math:`\exp(-(R - \min R)^2 / (2\sigma^2))`: the most repeatable view scores 1;
    - ``"paper"``: :math:`\exp(-(R - \mathrm{mean} R)^2 / (2\sigma^2))`, which favours average views.

    ``rep`` is (B, N) in [0, 1]; ``sigma`` is the paper's :math:`\sigma_r`.

    Example:
        >>> repeatability_score(torch.tensor([[0.5, 0.4]]))[0].tolist()[0]
        1.0
    """
    return torch.exp(log_repeatability_score(rep, mode, sigma))


def log_repeatability_score(rep: Tensor, mode: str, sigma: float) -> Tensor:
    check_option(mode, REPEATABILITY_MODES, "mode")
    check_positive(sigma, "sigma")
    R = 1.0 - rep
    centre = R.amin(dim=1, keepdim=True) if mode == "monotone" else R.mean(dim=1, keepdim=True)
    return -(R - centre).square() / (2.0 * sigma**2)


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


def inner_products(queries: Tensor, views: Tensor) -> Tensor:
    """(B, N) inner products of float32 (B, D) with (N, D) of any type, which are converted a few at a time."""
    return torch.cat([queries @ few.float().T for few in views.split(VIEWS_AT_A_TIME)], dim=1)


def matched_fraction(matched: Tensor, points: Tensor) -> Tensor:
    return matched / points.sum(dim=1, keepdim=True).clamp(min=torch.finfo(torch.float32).tiny)


def box_shapes(boxes: Tensor) -> Tensor:
    """(...,) log of width / height of (..., 4) boxes x0, y0, x1, y1.

    Example:
        >>> box_shapes(torch.tensor([0.0, 0.0, 10.0, 10.0])).item()
        0.0
    """
    sides = boxes[..., 2:] - boxes[..., :2]
    return torch.log(sides[..., 0] / sides[..., 1])


def whole_box_shapes(boxes: Tensor, sizes: Sequence[tuple[int, int]]) -> Tensor:
    """(B,) shapes of (B, 4) boxes in px in images of ``sizes`` (H, W); NaN if the border may cut the object off.

    Example:
        >>> whole_box_shapes(torch.tensor([[9.0, 9, 19, 19], [-0.5, 9, 19, 19]]), [(48, 64)] * 2).tolist()
        [0.0, nan]
    """
    end = torch.tensor([[W, H] for H, W in sizes], dtype=boxes.dtype, device=boxes.device).view(-1, 2) - 0.5
    border = 1.0 + BORDER_DISTANCE * (boxes[:, 2:] - boxes[:, :2]).amax(dim=1, keepdim=True)
    inside = (boxes[:, :2] > -0.5 + border).all(dim=1) & (boxes[:, 2:] < end - border).all(dim=1)
    return torch.where(inside, box_shapes(boxes), torch.nan)


def box_shape_score(queries: Tensor, views: Tensor, *, sigma: float = 0.2) -> Tensor:
    r"""S_box in (0, 1] per query, best view 1: :math:`\exp(-(d^2 - \min d^2) / (2\sigma^2))`.

    d is the difference of the logs of width / height.

    Args:
        queries: (B,) shapes of the photographs' boxes; NaN = unknown, every view then scores 1.
        views: (N,) shapes of the views' boxes, finite.
        sigma: 0.2 corresponds to a box that is a fifth too wide.

    Example:
        >>> box_shape_score(torch.tensor([0.0, float("nan")]), torch.tensor([0.0, 0.2])).round(decimals=2)
        tensor([[1.0000, 0.6100],
                [1.0000, 1.0000]])
    """
    check_tensor(queries, "queries", (None,))
    check_tensor(views, "views", (None,))
    check_positive(sigma, "sigma")
    if bool(queries.isinf().any()):
        raise InvalidInputError("queries: expected finite shapes, or NaN for unknown ones, got inf; a box has no area")
    check_box_shapes(views)
    return shape_scores(queries, views, sigma)


def check_box_shapes(shapes: Tensor) -> None:
    if bad := int((~shapes.isfinite()).sum()):
        raise InvalidInputError(
            f"views: expected finite shapes, got {bad} of {len(shapes)} NaN or infinite; their boxes have no area"
        )


def shape_scores(queries: Tensor, views: Tensor, sigma: float) -> Tensor:
    square = (queries[:, None] - views.to(queries)[None]).nan_to_num(0.0).square()
    return torch.exp((square.amin(dim=1, keepdim=True) - square) / (2.0 * sigma**2))
