"""Rotations of shapes and scenes."""

import numpy as np
import torch

from ...geometry.conversions import rotation_from_quaternion
from .surfaces import Array, Rng


def random_rotation(rng: Rng) -> Array:
    """(3, 3) rotation, uniformly distributed because a quaternion of normal numbers has no preferred direction."""
    return np.asarray(rotation_from_quaternion(torch.from_numpy(rng.normal(size=4))))


def rotation(axis: int, angle: float) -> Array:
    """(3, 3) rotation by ``angle`` radians about coordinate axis 0, 1 or 2."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R
