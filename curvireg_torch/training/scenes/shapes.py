"""Procedural objects, each generated from a random seed."""

from typing import NamedTuple

import numpy as np
import trimesh

from .families import FAMILIES
from .surfaces import Array, Rng, join

__all__ = ["FAMILIES", "Shape", "random_shape", "shape_from_mesh"]


class Shape(NamedTuple):
    """An object of radius 1 around the origin, z up: vertices (V, 3), faces (F, 3) and their material numbers (F,)."""

    vertices: Array
    faces: Array
    materials: Array

    def mesh(self) -> trimesh.Trimesh:
        """The shape as a mesh without materials."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def shape_from_mesh(mesh: trimesh.Trimesh) -> Shape:
    """A mesh, centred and scaled to radius 1, with one material per connected part.

    Triangles are connected if they share an edge in space, not vertex numbers: STL files repeat every corner, and
    other formats repeat those along texture seams.
    """
    vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces)
    points = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)
    adjacent = trimesh.graph.face_adjacency(faces=points[faces])
    labels = trimesh.graph.connected_component_labels(adjacent, node_count=len(faces))
    return _normalised(vertices, faces, np.asarray(labels) % 12)


def random_shape(rng: Rng, family: str | None = None) -> Shape:
    """A random shape of the named family of ``FAMILIES``, or of a random family.

    Example:
        >>> shape = random_shape(np.random.default_rng(0), "chair")
        >>> bool(np.linalg.norm(shape.vertices, axis=1).max() <= 1.0 + 1e-6)
        True
    """
    names = list(FAMILIES)
    parts = FAMILIES[family or names[rng.integers(len(names))]](rng)
    surface = join([part for part, _ in parts])
    materials = np.concatenate([np.full(len(part.faces), number) for part, number in parts])
    points = surface.vertices * rng.uniform(0.8, 1.25, 3)
    if rng.random() < 0.3:  # lean or taper the whole
        z = (points[:, 2:] - points[:, 2].mean()) / max(float(np.ptp(points[:, 2])), 1e-9)
        points[:, :2] = points[:, :2] * (1 + rng.uniform(-0.3, 0.3) * z) + rng.normal(0, 0.1, 2) * z
    return _normalised(points, surface.faces, materials)


def _normalised(points: Array, faces: Array, materials: Array) -> Shape:
    points = points - 0.5 * (points.min(axis=0) + points.max(axis=0))
    return Shape(points / max(float(np.linalg.norm(points, axis=1).max()), 1e-9), faces, materials)
