"""Why a mesh is not in a photograph at a pose that a user gives."""

from itertools import product

import torch
from torch import Tensor

from ..errors import LostObjectError
from .inputs import MIN_BOX_SIDE
from .tracker import boxes_at

FACTORS = {
    1000.0: "too small, as metres beside a mesh in mm",
    0.001: "too large, as mm beside a mesh in metres",
}
"""Factors between translations and the mesh's unit, and what they mean."""

OPENGL = (
    "at the start the object lies behind the camera: a pose of OpenGL's camera? Then turn y and z "
    "around"
)

INVERSE = (
    "at the start the mesh lies outside the photograph: the pose of the camera in the object? Then "
    "give its inverse"
)


def why_outside(
    hull: Tensor, T: Tensor, K: Tensor, size: tuple[int, int]
) -> LostObjectError | None:
    """What is probably wrong with a pose (4, 4) at which a mesh is not seen; None if nobody knows.

    Args:
        hull: (V, 3) points of the mesh.
        T: (4, 4) model -> camera.
        K: (3, 3).
        size: (H, W) of the photograph.
    """
    for sign, factor in product((1.0, -1.0), (1.0, *FACTORS)):
        changed = T.clone()
        changed[1:3] *= sign
        changed[:3, 3] *= factor
        if (sign, factor) == (1.0, 1.0) or not _is_seen(hull, changed, K, size):
            continue
        unit = "" if factor == 1.0 else f"{FACTORS[factor]}; give translations in the mesh's unit"
        if sign == 1.0:
            return LostObjectError(f"at the start the translation is about 1000 times {unit}")
        also = f". Its translation is about 1000 times {unit}" if unit else ""
        return LostObjectError(f"{OPENGL}{also}", kind="opengl")
    inverse = torch.linalg.inv(T)
    if _is_seen(hull, inverse, K, size):
        return LostObjectError(INVERSE)
    inverse[1:3] *= -1.0
    if _is_seen(hull, inverse, K, size):
        return LostObjectError(f"{INVERSE} with y and z turned around, as of OpenGL's camera")
    return None


def _is_seen(hull: Tensor, T: Tensor, K: Tensor, size: tuple[int, int]) -> bool:
    """Whether a mesh fills a sensible part of the photograph: its centre is in it, it is neither
    tiny nor huge."""
    boxes, visible = boxes_at(hull, T[None], K[None], size)
    (x0, y0, x1, y1) = boxes[0].tolist()
    side = max(x1 - x0, y1 - y0)
    centre = torch.tensor([(x0 + x1) / 2, (y0 + y1) / 2])
    inside = bool((centre >= 0).all()) and bool((centre < torch.tensor([size[1], size[0]])).all())
    return bool(visible) and inside and MIN_BOX_SIDE <= side <= 2 * max(size)
