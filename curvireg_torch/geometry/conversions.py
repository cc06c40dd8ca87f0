"""Conversions between the OpenCV camera (x right, y down, z forward; the centre of pixel (i, j) is
(i, j)) and the OpenGL camera (x right, y up, z backward; (i + 0.5, j + 0.5)), of axis-angle
vectors, and of BOP's symmetries.

All functions raise :class:`InvalidInputError` for other shapes and dtypes and for what is no
rotation, rigid transform or camera.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.aliases import Document
from ..utils.checks import (
    check_fraction,
    check_last_axes,
    check_numbers,
    check_pose,
    check_rotation,
)
from ..utils.precision import full_precision


def opengl_from_opencv(T_cam_from_model: Tensor) -> Tensor:
    """(..., 4, 4) transforms into the OpenGL camera, from those into the OpenCV camera: view
    matrices, whose inverse is the camera's pose in the model frame, as trimesh and Blender expect
    it.

    Example:
        >>> T = torch.eye(4); T[2, 3] = 5.0  # in front of OpenCV's camera
        >>> float(opengl_from_opencv(T)[2, 3])
        -5.0
    """
    check_pose(T_cam_from_model, "T_cam_from_model")
    signs = torch.tensor(
        [1.0, -1.0, -1.0, 1.0], dtype=T_cam_from_model.dtype, device=T_cam_from_model.device
    )
    return T_cam_from_model * signs[:, None]


def opencv_from_opengl(T_cam_from_model: Tensor) -> Tensor:
    """Inverse of :func:`opengl_from_opencv`: flipping two axes is its own inverse.

    Example:
        >>> T = torch.eye(4); T[2, 3] = -5.0  # in front of OpenGL's camera
        >>> float(opencv_from_opengl(T)[2, 3])
        5.0
    """
    return opengl_from_opencv(T_cam_from_model)


def axis_angle_from_rotation(R: Tensor) -> Tensor:
    """(..., 3, 3) rotations to (..., 3) axis x angle, the angle in radians, at most pi.

    Example:
        >>> turn = torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64)
        >>> back = axis_angle_from_rotation(rotation_from_axis_angle(turn))
        >>> [round(float(angle), 6) for angle in back]
        [0.0, 0.3, 0.0]
    """
    check_rotation(R, "R")
    from kornia.geometry import conversions  # here, because its import takes 0.3 s

    quaternion = conversions.rotation_matrix_to_quaternion(R.contiguous())
    axis_angle: Tensor = conversions.quaternion_to_axis_angle(quaternion)
    return axis_angle


@full_precision()
def rotation_from_axis_angle(axis_angle: Tensor) -> Tensor:
    """(..., 3) axis x angle in radians to (..., 3, 3) rotations, by Rodrigues' formula.

    Example:
        >>> rotation_from_axis_angle(torch.tensor([0.0, 0.0,
        ...     torch.pi / 2])).round(decimals=3).abs().tolist()
        [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    check_last_axes(axis_angle, "axis_angle", (3,))
    angle = torch.linalg.vector_norm(axis_angle, dim=-1)[..., None, None]
    W = cross_matrix(axis_angle)
    # sin(a) / a and (1 - cos(a)) / a^2; sinc does not divide by zero.
    first = torch.sinc(angle / torch.pi)
    second = 0.5 * torch.sinc(angle / (2.0 * torch.pi)).square()
    R: Tensor = torch.eye(3, dtype=W.dtype, device=W.device) + first * W + second * (W @ W)
    return R


def cross_matrix(vector: Tensor) -> Tensor:
    """(..., 3) vectors to the (..., 3, 3) matrices [v]x whose product with x is the cross product v
    x x."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(*vector.shape, 3)


def matrix_of_rows(rows: Sequence[Sequence[Tensor]]) -> Tensor:
    """(..., M, N) matrices of M rows of N entries (...)."""
    return torch.stack([torch.stack(tuple(row), -1) for row in rows], -2)


def symmetry_transforms(info: Document, *, max_step_fraction: float = 0.01) -> Tensor:
    """All symmetries of an object as 4x4 transforms, from its entry in BOP's ``models_info.json``.

    Each discrete symmetry is followed by each rotation about each continuous axis, in
    ``ceil(pi / max_step_fraction)`` steps: a vertex is at most half a diameter from an axis.

    Args:
        info: optional ``symmetries_discrete`` (lists of 16 numbers, row-major 4x4 matrices) and
            ``symmetries_continuous`` (``{"axis": [x, y, z], "offset": [x, y, z]}``, the offset a
            point of the axis).
        max_step_fraction: in (0, 1], the largest step of a vertex as a fraction of the object's
            diameter, BOP's 0.01.

    Returns:
        (S, 4, 4) float64 on the CPU, S >= 1, in the unit of ``info`` (BOP: mm); the identity comes
        first.

    Raises:
        InvalidInputError: wrong number of values, an axis of length 0, or ``max_step_fraction`` out
            of range.

    Example:
        >>> symmetry_transforms({"symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0,
        ...     0]}]}).shape
        torch.Size([315, 4, 4])
    """
    check_fraction(max_step_fraction, "max_step_fraction")
    matrices = [
        check_numbers(matrix, "symmetries_discrete", 16)
        for matrix in _list(info, "symmetries_discrete")
    ]
    discrete = torch.stack(
        [torch.eye(4, dtype=torch.float64), *(matrix.view(4, 4) for matrix in matrices)]
    )
    count = math.ceil(math.pi / max_step_fraction)
    angles = (torch.arange(1, count, dtype=torch.float64) * (2.0 * math.pi / count))[:, None]
    rotations = [discrete[:1]]
    for symmetry in _list(info, "symmetries_continuous"):
        if not isinstance(symmetry, Mapping):
            raise InvalidInputError(
                f"symmetries_continuous: expected axis and offset, got {symmetry!r:.80}"
            )
        axis = check_numbers(symmetry.get("axis"), "axis", 3)
        offset = check_numbers(symmetry.get("offset", (0.0, 0.0, 0.0)), "offset", 3)
        length = torch.linalg.vector_norm(axis)
        if not bool(length > 0):
            raise InvalidInputError(
                f"axis: expected a direction of length > 0, got {axis.tolist()}"
            )
        about_axis = torch.eye(4, dtype=torch.float64).repeat(count - 1, 1, 1)
        about_axis[:, :3, :3] = rotation_from_axis_angle(angles * axis / length)
        about_axis[:, :3, 3] = offset - about_axis[:, :3, :3] @ offset
        rotations.append(about_axis)
    # (C, 1, 4, 4) @ (D, 4, 4): the discrete symmetry acts first.
    return (torch.cat(rotations).unsqueeze(1) @ discrete).flatten(0, 1)


def _list(info: Document, key: str) -> Sequence[Any]:
    values = info.get(key, ())
    if not isinstance(values, list | tuple):
        raise InvalidInputError(f"{key}: expected a list, got {values!r:.80}")
    return values
