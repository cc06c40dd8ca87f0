"""Symmetries of BOP objects, and view sets without symmetric duplicates."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_fraction, check_positive, check_symmetries
from .conversions import rotation_from_axis_angle
from .views import ViewSphere


def symmetry_transforms(info: Mapping[str, Any], *, max_step_fraction: float = 0.01) -> Tensor:
    """All symmetries of an object as 4x4 transforms, from its entry in BOP's ``models_info.json``.

    Each discrete symmetry is followed by each rotation about each continuous axis, in ``ceil(pi / max_step_fraction)``
    steps: a vertex is at most half a diameter from an axis, so that a step moves it by at most ``max_step_fraction``
    diameters. BOP prescribes 0.01 (315 steps).

    Args:
        info: optional ``symmetries_discrete`` (lists of 16 numbers, row-major 4x4 matrices) and
            ``symmetries_continuous`` (``{"axis": [x, y, z], "offset": [x, y, z]}``, the offset a point of the axis).
        max_step_fraction: in (0, 1], the largest step of a vertex as a fraction of the object's diameter.

    Returns:
        (S, 4, 4) float64 on the CPU, S >= 1, in the unit of ``info`` (BOP: mm); the identity comes first.

    Raises:
        InvalidInputError: wrong number of values, an axis of length 0, or ``max_step_fraction`` out of range.

    Example:
        >>> symmetry_transforms({"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}).shape
        torch.Size([315, 4, 4])
    """
    check_fraction(max_step_fraction, "max_step_fraction")
    identity = torch.eye(4, dtype=torch.float64)
    matrices = [_numbers(matrix, 16, "symmetries_discrete") for matrix in info.get("symmetries_discrete", ())]
    discrete = torch.stack([identity, *(matrix.view(4, 4) for matrix in matrices)])
    rotations = [identity[None]]
    for symmetry in info.get("symmetries_continuous", ()):
        axis = _numbers(symmetry["axis"], 3, "axis")
        offset = _numbers(symmetry.get("offset", (0.0, 0.0, 0.0)), 3, "offset")
        rotations.append(_axis_rotations(axis, offset, math.ceil(math.pi / max_step_fraction)))
    # (C, 1, 4, 4) @ (D, 4, 4): the discrete symmetry acts first.
    return (torch.cat(rotations).unsqueeze(1) @ discrete).flatten(0, 1)


def views_without_symmetric(views: ViewSphere, symmetries: Tensor, *, tolerance: float = 1.0) -> ViewSphere:
    """The views, in their order, without those that an earlier one at the same distance shows up to a symmetry.

    Args:
        symmetries: (S, 4, 4) or (S, 3, 3) of the model, from :func:`symmetry_transforms`.
        tolerance: degrees within which two views count as the same. For a regular grid half a step of the symmetries
            suffices (0.6 degrees for BOP's 315 steps); for a scattered sampling use its covering radius.

    Raises:
        InvalidInputError: symmetries of another shape or not rigid, or a negative tolerance.

    Example:
        >>> from curvireg_torch.geometry import sample_views
        >>> about_z = symmetry_transforms({"symmetries_continuous": [{"axis": [0, 0, 1]}]})
        >>> len(views_without_symmetric(sample_views(elevations=[0, 30]), about_z))
        2
    """
    check_positive(tolerance, "tolerance", zero_ok=True)
    check_symmetries(symmetries)
    R = views.rotations.double()
    S = symmetries[:, :3, :3].to(R)
    # |A - B|_F = 2 sqrt(2) sin(angle / 2); float32 angles carry about 1e-5 degrees.
    limit = 3.0 - 4.0 * math.sin(math.radians(tolerance + 1e-3) / 2.0) ** 2
    kept: list[int] = []
    remaining = torch.ones(len(views), dtype=torch.bool)
    for i in range(len(views)):
        if not remaining[i]:
            continue
        kept.append(i)
        later = remaining.nonzero()[:, 0]
        traces = (R[i] @ S).flatten(1) @ R[later].flatten(1).T  # (S, L) traces of (R_i S)^T R_j
        same = (traces.amax(dim=0) >= limit) & (views.distance[later] == views.distance[i]).cpu()
        remaining[later[same]] = False
    return views[torch.tensor(kept)]


def _numbers(values: Any, count: int, name: str) -> Tensor:
    numbers = torch.as_tensor(values, dtype=torch.float64).flatten()
    if len(numbers) != count or not bool(numbers.isfinite().all()):
        raise InvalidInputError(f"{name}: expected {count} finite numbers, got {values}")
    return numbers


def _axis_rotations(axis: Tensor, offset: Tensor, count: int) -> Tensor:
    """(count - 1, 4, 4) rotations by multiples of 360 / count degrees about the axis through ``offset``."""
    length = torch.linalg.vector_norm(axis)
    if not bool(length > 0):
        raise InvalidInputError(f"axis: expected a direction of length > 0, got {axis.tolist()}")
    angles = (torch.arange(1, count, dtype=torch.float64) * (2.0 * math.pi / count))[:, None]
    transforms = torch.eye(4, dtype=torch.float64).repeat(count - 1, 1, 1)
    transforms[:, :3, :3] = rotation_from_axis_angle(angles * axis / length)
    transforms[:, :3, 3] = offset - transforms[:, :3, :3] @ offset
    return transforms
