"""Symmetries of BOP objects."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import as_numbers, check_fraction
from .conversions import rotation_from_axis_angle


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
    matrices = [_numbers(matrix, 16, "symmetries_discrete") for matrix in _list(info, "symmetries_discrete")]
    discrete = torch.stack([torch.eye(4, dtype=torch.float64), *(matrix.view(4, 4) for matrix in matrices)])
    rotations = [discrete[:1]]
    for symmetry in _list(info, "symmetries_continuous"):
        if not isinstance(symmetry, Mapping):
            raise InvalidInputError(f"symmetries_continuous: expected axis and offset, got {symmetry!r:.80}")
        axis = _numbers(symmetry.get("axis"), 3, "axis")
        offset = _numbers(symmetry.get("offset", (0.0, 0.0, 0.0)), 3, "offset")
        rotations.append(_axis_rotations(axis, offset, math.ceil(math.pi / max_step_fraction)))
    # (C, 1, 4, 4) @ (D, 4, 4): the discrete symmetry acts first.
    return (torch.cat(rotations).unsqueeze(1) @ discrete).flatten(0, 1)


def _list(info: Mapping[str, Any], key: str) -> Sequence[Any]:
    values = info.get(key, ())
    if not isinstance(values, list | tuple):
        raise InvalidInputError(f"{key}: expected a list, got {values!r:.80}")
    return values


def _numbers(values: Any, count: int, name: str) -> Tensor:
    numbers = as_numbers(values, name, dtype=torch.float64).flatten()
    if len(numbers) != count or not bool(numbers.isfinite().all()):
        raise InvalidInputError(f"{name}: expected {count} finite numbers, got {values!r:.80}")
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
