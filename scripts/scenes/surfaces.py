"""Elementary surfaces that shapes are built from."""

from typing import NamedTuple, TypeAlias

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from curvireg_torch.utils.arrays import Array

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


class Parts:
    """Surfaces with material numbers; parts with the same number have the same material."""

    def __init__(self) -> None:
        self.surfaces = []
        self.materials = []

    def add(
        self,
        surface: Surface,
        material: int,
        at: ArrayLike | None = None,
        rotation: Array | None = None,
    ) -> None:
        """Add a surface, rotated and moved by ``at``."""
        self.surfaces.append(surface if at is None else surface.moved(at, rotation))
        self.materials.append(np.full(len(surface.faces), material))

    def joined(self) -> tuple[Surface, Array]:
        """One surface, and the material numbers (F,) of its faces."""
        return join(self.surfaces), np.concatenate(self.materials)


def rotation(axis: int, angle: float) -> Array:
    """(3, 3) rotation by ``angle`` radians about coordinate axis 0, 1 or 2."""
    c = np.cos(angle)
    s = np.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R = np.eye(3)
    R[[i, i, j, j], [i, j, i, j]] = c, -s, s, c
    return R


def middle_of(points: Array) -> Array:
    """(D,) middle of the box around points (N, D)."""
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


def with_radius_1(points: Array) -> Array:
    """Points (N, 3), moved so that the middle of their box is the origin, and scaled."""
    centred = points - middle_of(points)
    return centred / max(np.linalg.norm(centred, axis=1).max(), 1e-9)


def unit_circle(angles: Array) -> Array:
    """(N, 2) points at angles (N,) in radians."""
    return np.stack([np.cos(angles), np.sin(angles)], -1)


def grid(points: Array, *, caps: bool = True) -> Surface:
    """Triangles between the rows of (M, N, 3) points, which are closed; ``caps`` closes the
    ends."""
    m, n = points.shape[:2]
    i, j = np.mgrid[: m - 1, :n].reshape(2, -1)
    a = i * n + j
    b = i * n + (j + 1) % n
    c = a + n
    d = b + n
    faces = [np.stack([a, b, d], -1), np.stack([a, d, c], -1)]
    vertices = points.reshape(-1, 3)
    if caps:
        ring = np.arange(n)
        following = (ring + 1) % n
        last = (m - 1) * n
        low = np.full(n, m * n)
        faces.append(np.stack([following, ring, low], -1))
        faces.append(np.stack([last + ring, last + following, low + 1], -1))
        vertices = np.concatenate([vertices, points[[0, -1]].mean(axis=1)])
    return Surface(vertices, np.concatenate(faces))


def _circle(n: int = AROUND) -> Array:
    return unit_circle(2 * np.pi * np.arange(n) / n)


def raised(outlines: Array, heights: Array) -> Array:
    """(M, N, 3) points of (M, N, 2) outlines at heights along z: (M, 1, 1) of outlines, (N, 1) of
    their points."""
    z = np.broadcast_to(heights, (*outlines.shape[:2], 1))
    return np.concatenate([outlines, z], -1)


def loft(outlines: Array, heights: ArrayLike) -> Surface:
    """Closed surface through (M, N, 2) outlines at (M,) heights along z."""
    levels = np.asarray(heights, dtype=float)
    return grid(raised(outlines, levels[:, None, None]))


def box(size: ArrayLike, *, top: float = 1.0) -> Surface:
    """Box of (3,) ``size`` around the origin; the upper end is scaled by ``top``."""
    x, y, z = 0.5 * np.broadcast_to(np.asarray(size, dtype=float), 3)
    square = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    outlines = np.stack([square, top * square])
    return loft(outlines, np.array([-z, z]))


def rounded_box(rng: Rng, size: ArrayLike) -> Surface:
    """A box of side lengths ``size``, with sharp or rounded edges."""
    if rng.random() < 0.5:
        narrower = rng.uniform(0.7, 1.0)
        return box(size, top=rng.choice([1.0, narrower]))
    e = rng.uniform(0.1, 0.5)
    return superquadric(0.5 * np.asarray(size), (e, e))


def extrude(outline: Array, height: float) -> Surface:
    """Extrusion of an outline (N, 2), star-shaped about its mean, by ``height`` around z = 0."""
    half = 0.5 * height
    return loft(np.stack([outline, outline]), np.array([-half, half]))


def lathe(radii: ArrayLike, heights: ArrayLike) -> Surface:
    """Surface of revolution about z through (M,) radii at (M,) heights."""
    radii = np.asarray(radii, dtype=float)[:, None, None]
    return loft(radii * _circle(), heights)


def disc(radius: float, low: float, high: float) -> Surface:
    """Cylinder about z between two heights."""
    return lathe(np.full(2, radius), np.array([low, high]))


def superquadric(size: ArrayLike, roundness: tuple[float, float]) -> Surface:
    """Superquadric with half axes ``size``: exponents 1 make an ellipsoid, towards 0 a box."""
    v = np.linspace(-0.5, 0.5, AROUND // 2 + 1) * np.pi
    ring = _power(_circle(), roundness[1])
    level = _power(unit_circle(v), roundness[0])
    points = raised(level[:, :1, None] * ring, level[:, 1:, None])
    return grid(points, caps=False).moved(scale=size)


def _power(x: Array, exponent: float) -> Array:
    return np.sign(x) * np.abs(x) ** exponent


def torus(radius: float, thickness: float) -> Surface:
    """Ring of ``radius`` about z."""
    around = _circle()
    around = np.concatenate([around, around[:1]])
    section = thickness * _circle(10)
    flat = around[:, None] * (radius + section[:, :1])
    return grid(raised(flat, section[:, 1:]), caps=False)


def bar(
    start: ArrayLike,
    end: ArrayLike,
    radius: float,
    *,
    sides: int = 10,
) -> Surface:
    """Straight rod between two points; ``sides=4`` makes it square."""
    a = np.asarray(start, dtype=float)
    b = np.asarray(end, dtype=float)
    axis = (b - a) / max(np.linalg.norm(b - a), 1e-9)
    shortest = np.abs(axis).argmin()
    side = np.cross(axis, np.eye(3)[shortest])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side)])
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    ring = radius * unit_circle(angles) @ frame
    return grid(np.stack([a + ring, b + ring]))


def join(surfaces: list[Surface]) -> Surface:
    """One surface of several."""
    vertices, faces = zip(*surfaces, strict=True)
    return Surface(*trimesh.util.append_faces(vertices, faces))
