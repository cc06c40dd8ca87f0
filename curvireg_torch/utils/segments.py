"""Choices within segments: rows of one table that belong to different
things, which a number in each row tells apart."""

import torch
from torch import Tensor

__all__ = ["best_within", "order_within", "place_within"]


def order_within(scores: Tensor, segment: Tensor) -> Tensor:
    """(N,) rows in the order of their ``segment`` (N,), within each by falling ``scores``
    (N,); ties in the order of the rows.

    Example:
        >>> order_within(torch.tensor([1.0, 3.0, 2.0]), torch.tensor([1, 0, 1])).tolist()
        [1, 2, 0]
    """
    order = scores.argsort(descending=True, stable=True)
    return order[segment[order].argsort(stable=True)]


def place_within(scores: Tensor, segment: Tensor) -> Tensor:
    """(N,) int64: how many rows of its segment come before a row in :func:`order_within`.

    Example:
        >>> place_within(torch.tensor([1.0, 3.0, 2.0]), torch.tensor([1, 0, 1])).tolist()
        [1, 0, 0]
    """
    order = order_within(scores, segment)
    ordered = segment[order].contiguous()
    place = torch.arange(len(order), device=order.device) - torch.searchsorted(ordered, ordered)
    return torch.empty_like(place).index_copy(0, order, place)


def best_within(scores: Tensor, segment: Tensor) -> Tensor:
    """(S,) the row with the highest score of each segment that has rows, by the number of the
    segment; of ties the first.

    Example:
        >>> best_within(torch.tensor([1.0, 3.0, 2.0]), torch.tensor([1, 0, 1])).tolist()
        [1, 2]
    """
    best = (place_within(scores, segment) == 0).nonzero()[:, 0]
    return best[segment[best].argsort()]
