"""Rotations that map the shape of a mesh to itself."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from ..geometry import rotation_from_axis_angle
from .mesh import mesh_radius

__all__ = ["mesh_symmetries"]

POINTS, TESTED = 40_000, 2_000
"""Random points of the surface, and how many of them are compared with all."""

TOLERANCE, FRACTION = 0.03, 0.995
"""A rotation is a symmetry if so large a fraction of the points lands within 0.03 radii of the surface: about 2 px of
a crop of 128 px, which hardly changes its contours, while a handle does."""

ROUND = 36
"""Rotations that stand for a body of revolution; steps of 10 degrees are those of a bank."""

ORDERS = (2, 3, 4, 5, 6, 8)
"""Orders of rotation that are looked for about each axis."""

LARGEST_GROUP = 2 * ROUND
"""Those of a cylinder. A cube has 24; a sphere has more, of which as many are found."""

DEFINED = 0.05
"""A principal axis is well defined if its moment differs from the others by so large a fraction of the largest."""

NEARLY_EQUAL = 1.0 + 2.0 * math.cos(math.radians(3.0))
"""Trace of A^T B from which two rotations count as one: 3 degrees apart."""


def mesh_symmetries(mesh: trimesh.Trimesh) -> Tensor:
    """Rotations about the centroid of a mesh's surface that leave its shape as it is; colours are not compared.

    The axes that are tried are those of the mesh file and the principal axes of its surface. About each, bodies of
    revolution and rotations of order 2 to 6 and 8 are found; products of symmetries are symmetries too.

    Returns:
        (S, 4, 4) float64 transforms of the model frame, the identity first; S = 1 for a mesh without symmetries.

    Example:
        >>> mesh_symmetries(trimesh.creation.box((1, 2, 3))).shape  # half turns about three axes
        torch.Size([4, 4, 4])
    """
    centre = torch.from_numpy(np.array(mesh.centroid, dtype=np.float64))  # which every symmetry maps to itself
    cloud = np.asarray(trimesh.sample.sample_surface(mesh, POINTS, seed=0)[0])
    cloud = (cloud - centre.numpy()) / mesh_radius(mesh)
    tree, some = cKDTree(cloud), cloud[:: POINTS // TESTED]

    def fits(axis: Tensor, angle: float) -> bool:
        R = rotation_from_axis_angle(angle * axis).numpy()
        return _close(tree, some[::20] @ R.T) and _close(tree, some @ R.T)

    turns, revolutions = [], []
    for axis in _axes(cloud):
        if all(fits(axis, angle) for angle in (1.0, 2.3)):
            revolutions.append(axis)
        else:
            turns += [(axis, 2.0 * math.pi / order) for order in ORDERS if fits(axis, 2.0 * math.pi / order)]
    if revolutions:  # any half turn about another axis turns it upside down; more of them would add nothing
        upside_down = [(axis, math.pi) for axis in revolutions[1:]] + turns
        turns = [(revolutions[0], 2.0 * math.pi / ROUND), *upside_down[:1]]
    R = _group([rotation_from_axis_angle(angle * axis) for axis, angle in turns])
    transforms = torch.eye(4, dtype=torch.float64).repeat(len(R), 1, 1)
    transforms[:, :3, :3] = R
    transforms[:, :3, 3] = centre - R @ centre
    return transforms


def _close(tree: cKDTree, points: NDArray[np.float64]) -> bool:
    distance, _ = tree.query(points, distance_upper_bound=TOLERANCE)
    return float(np.isfinite(distance).mean()) >= FRACTION


def _axes(cloud: NDArray[np.float64]) -> list[Tensor]:
    """Unit axes of the file, and the principal axes of the surface that are well defined and differ from them."""
    moments, vectors = np.linalg.eigh(cloud.T @ cloud)
    gaps = np.diff(moments, prepend=-np.inf, append=np.inf)
    principal = vectors.T[np.minimum(gaps[:-1], gaps[1:]) > DEFINED * moments[2]]
    axes: list[Tensor] = []
    for axis in torch.from_numpy(np.concatenate([np.eye(3), principal])):
        if all(abs(float(axis @ other)) < math.cos(math.radians(10.0)) for other in axes):
            axes.append(axis)
    return axes


def _group(generators: Sequence[Tensor]) -> Tensor:
    """(S, 3, 3) products of rotations, the identity first."""
    members = [torch.eye(3, dtype=torch.float64)]
    for member in members:  # grows meanwhile
        for product in (member @ generator for generator in generators):
            traces = torch.stack(members).flatten(1) @ product.flatten()
            if float(traces.max()) < NEARLY_EQUAL and len(members) < LARGEST_GROUP:
                members.append(product)
    return torch.stack(members)
