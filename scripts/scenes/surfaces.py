"""Elementary surfaces that shapes are built from."""

from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

Array: TypeAlias = np.ndarray[Any, Any]
Rng: TypeAlias = np.random.Generator

AROUND = 36  # vertices around a round surface; enough for pictures of 128 px


class Surface(NamedTuple):
    """Vertices (V, 3) and triangles (F, 3)."""

    vertices: Array
    faces: Array

    def moved(
        self, translation: ArrayLike = 0.0, rotation: Array | None = None, scale: ArrayLike = 1.0
    ) -> "Surface":
        """The surface after scaling, rotation and translation, in this order."""
        points = self.vertices * np.asarray(scale, dtype=float)
        points = points if rotation is None else points @ rotation.T
        return Surface(points + np.asarray(translation, dtype=float), self.faces)


Part: TypeAlias = tuple[Surface, int]
"""A surface and its material number; parts with the same number have the same material."""


def _grid(points: Array, *, close: bool = True, caps: bool = True) -> Surface:
    """Triangles between the rows of (M, N, 3) points; ``close`` closes each row, ``caps`` the
    ends."""
    m, n = points.shape[:2]
    i, j = np.meshgrid(np.arange(m - 1), np.arange(n if close else n - 1), indexing="ij")
    a = i * n + j
    b = i * n + (j + 1) % n
    c = a + n
    d = b + n
    faces = [np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, d), (a, d, c))]
    vertices = points.reshape(-1, 3)
    if caps and close:
        ring = np.arange(n)
        last = (m - 1) * n
        following = (ring + 1) % n
        faces.append(np.stack([following, ring, np.full(n, m * n)], -1))
        faces.append(np.stack([last + ring, last + following, np.full(n, m * n + 1)], -1))
        vertices = np.concatenate([vertices, points[[0, -1]].mean(axis=1)])
    return Surface(vertices, np.concatenate(faces))


def _circle(n: int = AROUND) -> Array:
    t = 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(t), np.sin(t)], -1)


def loft(outlines: Array, heights: ArrayLike) -> Surface:
    """Closed surface through (M, N, 2) outlines at (M,) heights along z."""
    z = np.broadcast_to(np.asarray(heights, dtype=float)[:, None, None], (*outlines.shape[:2], 1))
    return _grid(np.concatenate([outlines, z], -1))


def box(size: ArrayLike, *, top: float = 1.0) -> Surface:
    """Box of (3,) ``size`` around the origin; the upper end is scaled by ``top``."""
    x, y, z = (0.5 * float(s) for s in np.broadcast_to(np.asarray(size, dtype=float), 3))
    square = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    return loft(np.stack([square, top * square]), np.array([-z, z]))


def rounded_box(rng: Rng, size: ArrayLike) -> Surface:
    """A box of side lengths ``size``, with sharp or rounded edges."""
    if rng.random() < 0.5:
        return box(size, top=rng.choice([1.0, rng.uniform(0.7, 1.0)]))
    e = rng.uniform(0.1, 0.5)
    return superquadric(0.5 * np.asarray(size), (e, e))


def extrude(outline: Array, height: float) -> Surface:
    """Extrusion of an outline (N, 2), star-shaped about its mean, by ``height`` around z = 0."""
    return loft(np.stack([outline, outline]), np.array([-0.5 * height, 0.5 * height]))


def lathe(radii: ArrayLike, heights: ArrayLike) -> Surface:
    """Surface of revolution about z through (M,) radii at (M,) heights."""
    return loft(np.asarray(radii, dtype=float)[:, None, None] * _circle(), heights)


def superquadric(size: ArrayLike, roundness: tuple[float, float]) -> Surface:
    """Superquadric with half axes ``size``: exponents 1 make an ellipsoid, towards 0 a box."""
    v = np.linspace(-0.5, 0.5, AROUND // 2 + 1) * np.pi
    ring = _power(_circle(), roundness[1])
    level = _power(np.stack([np.cos(v), np.sin(v)], -1), roundness[0])
    points = np.concatenate(
        [level[:, :1, None] * ring, np.broadcast_to(level[:, 1:, None], (len(v), AROUND, 1))], -1
    )
    return Surface(*_grid(points, caps=False)).moved(scale=size)


def _power(x: Array, exponent: float) -> Array:
    return np.sign(x) * np.abs(x) ** exponent


def torus(radius: float, thickness: float) -> Surface:
    """Ring of ``radius`` about z."""
    around = _circle()
    section = thickness * _circle(10)
    around = np.concatenate([around, around[:1]])
    reach = radius + section[:, 0]
    flat = around[:, None] * reach[None, :, None]
    return _grid(
        np.concatenate([flat, np.broadcast_to(section[None, :, 1:], (*flat.shape[:2], 1))], -1),
        caps=False,
    )


def bar(start: ArrayLike, end: ArrayLike, radius: float, *, sides: int = 10) -> Surface:
    """Straight rod between two points; ``sides=4`` makes it square."""
    a = np.asarray(start, dtype=float)
    b = np.asarray(end, dtype=float)
    axis = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    side = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side)])
    t = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = radius * np.stack([np.cos(t), np.sin(t)], -1) @ frame
    return _grid(np.stack([a + ring, b + ring]))


def tube(path: Array, radius: float) -> Surface:
    """Rods along a (N, 3) path."""
    return join([bar(a, b, radius) for a, b in pairwise(path)])


def join(surfaces: list[Surface]) -> Surface:
    """One surface of several."""
    first = np.cumsum([0] + [len(s.vertices) for s in surfaces[:-1]])
    return Surface(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate([s.faces + k for s, k in zip(surfaces, first, strict=True)]),
    )
