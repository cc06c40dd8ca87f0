"""Aspect ratio of the photograph's box against those of the views."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..utils.checks import check_positive, check_tensor
from .base import Term, Views
from .query import QueryFeatures

__all__ = ["BoxShape", "box_shape_score", "box_shapes", "whole_box_shapes"]

_BORDER = 0.01
"""A box edge this close to the image's border, as a fraction of the box's longer side plus 1 px, counts as cut off."""


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
    border = 1.0 + _BORDER * (boxes[:, 2:] - boxes[:, :2]).amax(dim=1, keepdim=True)
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
    _check_views(views)
    return _score(queries, views, sigma)


def _check_views(shapes: Tensor) -> None:
    if bad := int((~shapes.isfinite()).sum()):
        raise InvalidInputError(
            f"views: expected finite shapes, got {bad} of {len(shapes)} NaN or infinite; their boxes have no area"
        )


def _score(queries: Tensor, views: Tensor, sigma: float) -> Tensor:
    square = (queries[:, None] - views.to(queries)[None]).nan_to_num(0.0).square()
    return torch.exp((square.amin(dim=1, keepdim=True) - square) / (2.0 * sigma**2))


@dataclass(frozen=True)
class BoxShape(Term):
    """S_box: :func:`box_shape_score` with ``sigma``; 1 for all views if the box reaches the image's border."""

    name: ClassVar[str] = "box"
    sigma: float = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(self.sigma, "sigma")

    def build(self, views: Views) -> nn.Module:
        return _BoxShapeModule(box_shapes(views.boxes).float(), self.sigma)

    def log_score(self, raw: Tensor) -> Tensor:
        return raw.clamp(min=torch.finfo(raw.dtype).tiny).log()


class _BoxShapeModule(nn.Module):
    def __init__(self, shapes: Tensor, sigma: float) -> None:
        super().__init__()
        _check_views(shapes)
        self.sigma = sigma
        self.shapes: Tensor
        self.register_buffer("shapes", shapes, persistent=False)

    def forward(self, query: QueryFeatures) -> Tensor:
        return _score(query.shapes.float(), self.shapes, self.sigma)
