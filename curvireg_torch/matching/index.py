"""A first look among very many views: an inverted file of FAISS over their descriptors (extra ``faiss``)."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from .._checks import check_tensor
from ..errors import InvalidInputError, MissingDependencyError

__all__ = ["ViewIndex"]


class ViewIndex:
    """The views most like a query, found among very many without looking at all of them.

    Views are put into cells around ``sqrt(N)`` centres; a query looks into the ``probes`` nearest cells. What it finds
    is a short list, of models for instance (:meth:`ViewBank.locate`), to be ranked by a :class:`ViewMatcher`.
    How much it misses and when it pays is measured in ``docs/performance.md``.

    Args:
        descriptors: (N, D) of the views, whitened if the queries will be.
        probes: cells that are looked into.

    Raises:
        MissingDependencyError: faiss is not installed.

    Example:
        >>> index = ViewIndex(bank.descriptors)                                        # doctest: +SKIP
        >>> cosines, views = index.search(matcher.query([photo], box).descriptors[:, 0], 100)      # doctest: +SKIP
    """

    def __init__(self, descriptors: Tensor, *, probes: int = 16) -> None:
        check_tensor(descriptors, "descriptors", (None, None))
        if len(descriptors) < 1 or probes < 1:
            raise InvalidInputError(f"expected descriptors and probes >= 1, got {len(descriptors)} and {probes}")
        faiss = _faiss()
        N, D = descriptors.shape
        cells = max(1, int(N**0.5))
        self._centres = faiss.IndexFlatIP(D)
        self._index = faiss.IndexIVFFlat(self._centres, D, cells, faiss.METRIC_INNER_PRODUCT)
        self._index.cp.seed = 0
        self._index.cp.min_points_per_centroid = 1
        self._index.nprobe = min(probes, cells)
        x = _rows(descriptors)
        self._index.train(x)
        self._index.add(x)

    def __len__(self) -> int:
        return int(self._index.ntotal)

    def search(self, queries: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """The ``count`` best views found for (B, D) queries.

        Returns:
            (B, count) cosines, best first, and (B, count) view indices; -inf and -1 where the cells held fewer.
        """
        check_tensor(queries, "queries", (None, self._index.d))
        if count < 1:
            raise InvalidInputError(f"count: expected >= 1, got {count}")
        similarity, views = self._index.search(_rows(queries), count)
        found = torch.from_numpy(views)
        return torch.where(found >= 0, torch.from_numpy(similarity), -torch.inf), found


def _rows(descriptors: Tensor) -> np.ndarray:
    return np.ascontiguousarray(normalize(descriptors.detach().float(), dim=1).cpu().numpy())


def _faiss() -> Any:
    try:
        import faiss
    except ImportError as error:
        raise MissingDependencyError("ViewIndex: needs faiss; pip install 'curvireg_torch[faiss]'") from error
    return faiss
