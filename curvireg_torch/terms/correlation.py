"""Similarity of descriptors, and its map to (0, 1]."""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..utils.checks import check_option, check_tensor
from .base import Term, Views
from .query import QueryFeatures
from .whitening import Whitening, ledoit_wolf

__all__ = ["Correlation", "normalized_correlation", "unit_score"]


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
    return torch.exp(_log_score(similarity))


def _log_score(similarity: Tensor) -> Tensor:
    check_tensor(similarity, "similarity", (None, None))
    spread = (similarity - similarity.mean(dim=1, keepdim=True)).square().mean(dim=1, keepdim=True).sqrt()
    spread = torch.where(spread > 0, spread, torch.ones_like(spread))
    return (similarity - similarity.amax(dim=1, keepdim=True)) / spread


@dataclass(frozen=True)
class Correlation(Term):
    """S_hog: normalised correlation of descriptors, the best over the jittered crops, mapped by :func:`unit_score`.

    Attributes:
        whitening: "none", or "bank": both descriptors are whitened by the mean mu and the covariance Sigma of the
            bank's views before the cosine. The paper scores (D_view - mu)^T Sigma^-1 D_query with the same mu and
            Sigma. Here the photograph's descriptor is centred too, lengths are divided out, and Sigma is shrunk
            (Ledoit-Wolf), because a bank has fewer views than a descriptor has entries.
    """

    name: ClassVar[str] = "hog"
    whitening: str = "none"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_option(self.whitening, ("none", "bank"), "whitening")

    def build(self, views: Views) -> nn.Module:
        whitening = None if self.whitening == "none" else Whitening(*ledoit_wolf(views.descriptors))
        return CorrelationModule(views.descriptors, whitening)

    def log_score(self, raw: Tensor) -> Tensor:
        return _log_score(raw)


class CorrelationModule(nn.Module):
    """Compares photographs with (N, D) descriptors of views, whitened or not."""

    def __init__(self, descriptors: Tensor, whitening: Whitening | None = None) -> None:
        super().__init__()
        self.whitening = whitening
        self.views: Tensor
        self.register_buffer("views", self._normalized(descriptors), persistent=False)

    def _normalized(self, descriptors: Tensor) -> Tensor:
        return F.normalize(descriptors if self.whitening is None else self.whitening(descriptors), dim=1)

    def forward(self, query: QueryFeatures) -> Tensor:
        B, K = query.descriptors.shape[:2]
        queries = self._normalized(query.descriptors.flatten(0, 1)).to(self.views.dtype)
        return (queries @ self.views.T).float().view(B, K, len(self.views)).amax(dim=1)
