"""Views far apart from each other, which stand for all views of a bank, and the appearance of
views, described once and stored beside the bank."""

import math
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..utils.checks import check_symmetries
from ..utils.files import keep_tensors, kept_tensors
from ..utils.precision import full_precision

ROUNDING_OF_TRACE = 1e-5  # so that views exactly as far apart as the angle count as one
MAX_STORED_VIEWS = 2048
"""Views whose appearance is kept, 35 kB each at 128 px. A packing of the 7200 default views at 20
degrees has 942."""


class Packing(NamedTuple):
    """Of N views a few, far enough apart, that stand for the others.

    Attributes:
        representatives: (C,) their indices.
        cells: (N,) for each view, which representative is nearest to it.
    """

    representatives: Tensor
    cells: Tensor


def packing_of_views(rotations: Tensor, angle: float) -> Packing:
    """Representatives of views with rotations (N, 3, 3), more than ``angle`` degrees apart. They
    are the same for every photograph, so that few views of a mesh are ever described."""
    every = torch.arange(len(rotations), device=rotations.device)
    representatives = distinct_views(every, rotations, count=len(rotations), angle=angle)
    return Packing(representatives, cells_of_views(rotations, representatives))


def distinct_views(
    order: Tensor,
    rotations: Tensor,
    *,
    count: int,
    angle: float = 30.0,
    symmetries: Tensor | None = None,
) -> Tensor:
    """Best views that are more than ``angle`` degrees from every better selected one.

    Args:
        order: (N,) view indices, best first.
        rotations: (N, 3, 3) of the views.
        symmetries: (S, 3, 3) or (S, 4, 4) of the model, from
            :func:`curvireg_torch.geometry.symmetry_transforms`: views that differ by one of them
            count as the same.

    Returns:
        (K,) view indices, best first, K <= count.

    Example:
        >>> from curvireg_torch.geometry import rotation_from_viewpoint
        >>> R = rotation_from_viewpoint(torch.tensor([0.0, 10.0, 90.0]), 0.0)
        >>> distinct_views(torch.tensor([1, 0, 2]), R, count=2).tolist()
        [1, 2]
    """
    if symmetries is None:
        symmetries = torch.eye(3)[None]
    else:
        check_symmetries(symmetries)
    R, S = (
        x.detach().cpu().float().numpy() for x in (rotations, symmetries[:, :3, :3].to(rotations))
    )  # many small steps
    flat = R.reshape(-1, 9).T
    least = 1.0 + 2.0 * math.cos(math.radians(min(angle, 180.0))) - ROUNDING_OF_TRACE
    selected: list[int] = []
    available = np.ones(len(R), bool)
    for view in order.tolist():
        if len(selected) == count:
            break
        if available[view]:
            selected.append(view)
            available &= ((R[view] @ S).reshape(-1, 9) @ flat).max(axis=0) < least
    return torch.tensor(selected, dtype=torch.long, device=order.device)


def cells_of_views(rotations: Tensor, representatives: Tensor) -> Tensor:
    """(N,) index of the representative (C,) whose rotation is nearest to that of each view (N, 3,
    3)."""
    flat = rotations.flatten(1)
    # the trace of a relative rotation grows as its angle falls
    traces = flat @ flat[representatives].T
    return traces.argmax(dim=1)


def best_cells(log_scores: Tensor, cells: Tensor, *, count: int) -> Tensor:
    """At most ``count`` cells that hold the best views of one photograph, best first.

    Args:
        log_scores: (N,) of the views; minus infinity leaves a view out.
        cells: (N,) the cell of each view.
    """
    number = int(cells.max()) + 1
    best = log_scores.new_full((number,), -torch.inf).scatter_reduce(0, cells, log_scores, "amax")
    order = best.argsort(descending=True, stable=True)[:count]
    return order[best[order] > -torch.inf]


class DescribedViews:
    """Appearance features of views, by the index of the view: kept in memory, and in a file if
    there is one.

    The file is read when features are needed first, and written when these are released or the
    process ends; several processes may share it, and a damaged file counts as none.

    Args:
        path: the file; None keeps features in memory alone.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._features: dict[int, Tensor] = {}
        self._is_read = False
        self._stored: set[int] = set()
        if path is not None:
            weakref.finalize(self, _store, path, self._features, self._stored)

    def features(self, views: Sequence[int], describe: Callable[[list[int]], Tensor]) -> Tensor:
        """(U, D) features of views; those that are not known are described by ``describe``, which
        returns the float16 features of a list of views."""
        self._read()
        known = {view: self._features[view] for view in views if view in self._features}
        missing = [view for view in views if view not in known]
        if missing:
            described = dict(zip(missing, describe(missing), strict=True))
            if len(self._features) + len(described) > MAX_STORED_VIEWS:
                self._features.clear()
            self._features.update(described)
            known.update(described)
        return torch.stack([known[view] for view in views])

    def _read(self) -> None:
        if self._is_read or self._path is None:
            return
        stored = _read_features(self._path)
        self._stored.update(stored)
        self._features.update(stored)
        self._is_read = True


def _read_features(path: Path) -> dict[int, Tensor]:
    """Features by view from a file; none if it is missing or damaged."""
    found = kept_tensors(path)
    if found is None or found[0].keys() != {"views", "features"}:
        return {}
    tensors = found[0]
    return dict(zip(tensors["views"].tolist(), tensors["features"], strict=True))


@full_precision()
def _store(path: Path, features: dict[int, Tensor], stored: set[int]) -> None:
    """Add features to those of a file, unless it has them."""
    if features.keys() <= stored or not path.parent.is_dir():
        return
    together = _read_features(path) | features
    if len(together) > MAX_STORED_VIEWS:
        together = features
    views = sorted(together)
    tensors = {
        "views": torch.tensor(views),
        "features": torch.stack([together[view] for view in views]),
    }
    keep_tensors(path, tensors)
