"""Similarity of descriptors, and its map to (0, 1]."""

import torch
from torch import Tensor

from .._checks import check_tensor

__all__ = ["normalized_correlation", "unit_score"]


def normalized_correlation(queries: Tensor, views: Tensor) -> Tensor:
    """Cosine of every query with every view.

    Args:
        queries: (B, D).
        views: (N, D), any length; a zero descriptor scores 0.

    Returns:
        (B, N) in [-1, 1]; [0, 1] for HOG, whose entries are not negative.

    Example:
        >>> normalized_correlation(torch.tensor([[1.0, 0.0]]), torch.tensor([[2.0, 0.0], [0.0, 3.0]])).tolist()
        [[1.0, 0.0]]
    """
    check_tensor(queries, "queries", (None, None))
    check_tensor(views, "views", (None, queries.shape[1]))
    return torch.nn.functional.normalize(queries, dim=1) @ torch.nn.functional.normalize(views, dim=1).T


def unit_score(similarity: Tensor) -> Tensor:
    """Map similarities to (0, 1] per query, best view 1: ``exp((s - max s) / std s)``, a softmax of z-scores.

    Args:
        similarity: (B, N).

    Example:
        >>> unit_score(torch.tensor([[1.0, 1.0, 1.0]])).tolist()
        [[1.0, 1.0, 1.0]]
    """
    check_tensor(similarity, "similarity", (None, None))
    spread = similarity.std(dim=1, keepdim=True, correction=0)
    spread = torch.where(spread > 0, spread, torch.ones_like(spread))
    return torch.exp((similarity - similarity.amax(dim=1, keepdim=True)) / spread)
