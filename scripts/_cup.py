"""A cup with a handle: the mesh for scikit-image's photograph of a coffee cup."""

import numpy as np
import trimesh

__all__ = ["cup"]

OUTSIDE = [(0.0, 0.0), (22.0, 0.0), (30.0, 9.0), (37.0, 26.0), (40.0, 46.0), (41.0, 66.0)]
"""Radius and height in mm from the foot to the rim."""

INSIDE = [(37.0, 66.0), (36.0, 46.0), (33.0, 27.0), (26.0, 12.0), (18.0, 7.0), (0.0, 7.0)]
"""Radius and height in mm from the rim to the bottom."""

BOW, STRAP = (22.0, 13.0), (6.0, 3.0)
"""How far the handle reaches from the wall, and half its height; half the width and the thickness of its strap; mm."""


def cup() -> trimesh.Trimesh:
    """A cup of 82 mm across and 66 mm high, z up, its handle towards -y, in mm; as the eye judges it, not measured.

    Example:
        >>> cup().extents.round(1).tolist()
        [82.0, 103.0, 66.0]
    """
    body = trimesh.creation.revolve([*OUTSIDE, *INSIDE], sections=96)
    mesh = trimesh.util.concatenate([body, handle(wall=37.0, height=34.0)])
    mesh.units = "mm"
    return mesh


def handle(wall: float, height: float, rings: int = 32, corners: int = 24) -> trimesh.Trimesh:
    """A strap along half an ellipse that leaves the wall at ``height``."""
    turn, around = np.linspace(-np.pi / 2, np.pi / 2, rings)[:, None], np.linspace(0, 2 * np.pi, corners, False)
    out, up = BOW[0] + STRAP[1] * np.cos(around), BOW[1] + STRAP[1] * np.cos(around)
    x = np.broadcast_to(STRAP[0] * np.sin(around), (rings, corners))
    points = np.stack([x, -wall - out * np.cos(turn), height + up * np.sin(turn)], axis=-1).reshape(-1, 3)
    here = np.arange((rings - 1) * corners).reshape(rings - 1, corners)
    beside = np.roll(here, -1, axis=1)
    squares = np.stack([here, beside, beside + corners, here + corners], axis=-1).reshape(-1, 4)
    return trimesh.Trimesh(points, squares[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))
