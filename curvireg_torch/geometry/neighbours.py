"""The graph of neighbouring views: which views are coherent with which."""

import warnings

import torch
from torch import Tensor

from .._checks import check_tensor
from ..errors import InvalidInputError
from .viewpoint import rotation_error

__all__ = ["nearest_views"]


def nearest_views(rotations: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The nearest neighbours of every view, by the angle between rotations: in-plane turns count.

    Deprecated: nothing in the library needs it; :func:`rotation_error` gives the angles.

    Views within an angle are those of the first ``count`` whose returned angle is below it.

    Args:
        rotations: (N, 3, 3).
        count: neighbours, 1 <= count < N.

    Returns:
        indices (N, count), nearest first, never the view itself; degrees (N, count).

    Raises:
        InvalidInputError: wrong shape or count.

    Example:
        >>> from curvireg_torch.geometry import sample_views
        >>> R = sample_views(azimuth_step=90, elevations=[0]).rotations
        >>> with warnings.catch_warnings(action="ignore"):
        ...     indices, degrees = nearest_views(R, 2)
        >>> indices[0].sort().values.tolist(), [round(float(d)) for d in degrees[0]]
        ([1, 3], [90, 90])
    """
    warnings.warn("nearest_views is deprecated; rotation_error gives the angles", DeprecationWarning, stacklevel=2)
    check_tensor(rotations, "rotations", (None, 3, 3))
    N = len(rotations)
    if not 1 <= count < N:
        raise InvalidInputError(f"count: expected 1 <= count < {N} views, got {count}")
    flat = rotations.flatten(1).double()
    parts = []
    for start in range(0, N, 512):  # 512 x N at a time
        traces = flat[start : start + 512] @ flat.T
        rows = torch.arange(len(traces), device=traces.device)
        traces[rows, start + rows] = -torch.inf
        # A stable order: the first of several equally near views comes first. Equal to 1e-9, that is.
        parts.append((-(traces * 1e9).round()).argsort(dim=1, stable=True)[:, :count])
    indices = torch.cat(parts)
    return indices, rotation_error(rotations[:, None].double(), rotations[indices].double()).to(rotations.dtype)
