"""The sample of the page: a photograph of a coffee cup, and a mesh of the cup."""

from pathlib import Path

import numpy as np
import trimesh

__all__ = ["BOX", "CREDIT", "FIELD_OF_VIEW", "PHOTO", "cup"]

PHOTO = Path(__file__).parent / "static" / "coffee.jpg"
CREDIT = "photograph by Rachel Michetti, courtesy of Pikolo Espresso Bar (CC0); the mesh was modelled after it"
BOX = (172.0, 18.0, 409.0, 308.0)
"""Of the cup, in px."""
FIELD_OF_VIEW = 30.0
"""Horizontal, in degrees: an estimate from the ellipses in the photograph."""

# Radius and height in mm from the middle of the foot to the rim, and from the rim to the middle of the coffee
OUTSIDE = [(0.0, 0.0), (16.4, 0.0), (18.6, 4.3), (20.3, 14.2), (23.6, 28.5), (30.8, 46.3), (31.5, 64.1), (31.0, 71.2)]
INSIDE = [(25.9, 71.2), (24.2, 44.8), (0.0, 44.8)]
# Of the strap of the handle: where it leaves the wall (radius and height of its middle), how far it reaches from there
# and half its height, half its width and half its thickness
WALL, BOW, STRAP = (20.4, 25.0), (17.9, 15.0), (4.1, 2.0)
RED, CREAM, COFFEE = (140, 35, 12, 255), (235, 205, 175, 255), (195, 130, 55, 255)


def cup() -> trimesh.Trimesh:
    """A cup of 63 mm across and 71 mm high, z up, its handle towards -y, in mm and in colours.

    Its proportions are those that fit the photograph, its size is a guess.

    Example:
        >>> cup().extents.round().tolist()
        [63.0, 72.0, 71.0]
    """
    body = trimesh.creation.revolve([*OUTSIDE, *INSIDE], sections=72)
    strap = _handle(rings=24, corners=16)
    x, y, z = body.triangles_center.T
    wall_radius, wall_height = np.array(OUTSIDE[1:]).T
    inside = (z > 40.0) & (np.hypot(x, y) < np.interp(z, wall_height, wall_radius) - 1.0)
    colours = np.where(inside[:, None], CREAM, RED)
    colours[inside & (z < INSIDE[-1][1] + 0.1)] = COFFEE
    mesh = trimesh.util.concatenate([body, strap])
    mesh.visual.face_colors = np.concatenate([colours, np.tile(RED, (len(strap.faces), 1))]).astype(np.uint8)
    mesh.units = "mm"
    return mesh


def _handle(rings: int, corners: int) -> trimesh.Trimesh:
    """A strap of elliptic section along half an ellipse."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, rings)[:, None]
    around = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    out, up = (reach + STRAP[1] * np.cos(around) for reach in BOW)
    x = np.broadcast_to(STRAP[0] * np.sin(around), (rings, corners))
    points = np.stack([x, -WALL[0] - out * np.cos(turn), WALL[1] + up * np.sin(turn)], axis=-1)
    here = np.arange((rings - 1) * corners).reshape(rings - 1, corners)
    beside = np.roll(here, -1, axis=1)
    squares = np.stack([here, beside, beside + corners, here + corners], axis=-1).reshape(-1, 4)
    return trimesh.Trimesh(points.reshape(-1, 3), squares[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))
