"""Rotations that map the shape of a mesh to itself."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from ..geometry import rotation_from_axis_angle
from ..utils.arrays import Floats
from .alignment import are_near, axis_of, rigid_step
from .mesh import measure, mesh_radius
from .sampling import surface_points

# Random points of the surface, and how many of them are compared with all
POINTS = 40_000
TESTED = 2_000
# A rotation is a symmetry if so large a fraction of the points lands within 0.03 radii of the
# surface: about 2 px of a crop of 128 px, which hardly changes its contours. The pull tab of a can
# is less than the rest, a handle more.
TOLERANCE = 0.03
FRACTION = 0.975
# Mean distance in radii of the trusted points from which a rotation is given up. Axes of scanned
# meshes are tilted by a degree or two and do not pass through the centroid: 104 symmetries of 76
# meshes begin below 0.014.
NEAR_SYMMETRY = 0.04
# Iterations of ICP, the points that it moves, the fraction of them that it trusts in each
# iteration, and the degrees by which it may change a rotation
ALIGNMENT_STEPS = 8
ALIGNED_POINTS = 500
ALIGNED_FRACTION = 0.9
MAX_TILT = 5.0
# Distance in radii, and fraction of the surface that a symmetry moves farther off it, from which a
# feature tells it from the identity: a bump of about 0.05 radii. Scans of symmetric objects have
# hardly such a point.
FEATURE_HEIGHT = 0.05
FEATURE_FRACTION = 0.001
FEATURE_POINTS = 10_000
ROUND = 36  # Rotations that stand for a body of revolution; steps of 10 degrees are those of a bank
ORDERS = (2, 3, 4, 5, 6, 8)  # Orders of rotation that are looked for about each axis
# Those of a cylinder. A cube has 24; a sphere has more, of which as many are found.
LARGEST_GROUP = 2 * ROUND
# A principal axis is well defined if its moment differs from the others by so large a fraction of
# the largest
DEFINED = 0.05
# Trace of A^T B from which two rotations count as one: 5 degrees apart
NEARLY_EQUAL = 1.0 + 2.0 * math.cos(math.radians(5.0))


@measure
def mesh_symmetries(mesh: trimesh.Trimesh) -> Tensor:
    """Rotations of a mesh that leave its shape as it is, up to small details, without colours. (S,
    4, 4) float64 transforms of the model frame, the identity first; S = 1 for a mesh without
    symmetries.

    The axes that are tried are those of the mesh file and the principal axes of its surface, each
    aligned by ICP. About each, bodies of revolution and rotations of order 2 to 6 and 8 are found;
    products of symmetries are symmetries too.

    Example:
        >>> mesh_symmetries(trimesh.creation.box((1, 2, 3))).shape  # half turns about three axes
        torch.Size([4, 4, 4])
    """
    centre = np.array(mesh.centroid, dtype=np.float64)
    radius = mesh_radius(mesh)
    surface = _Surface((surface_points(mesh, POINTS) - centre) / radius)
    revolutions: list[_Line] = []
    turns: list[tuple[_Line, float]] = []
    for axis in _axes(surface.cloud):
        if all(lines := [surface.aligned(axis, angle) for angle in (1.0, 2.3)]):
            revolutions += [line for line in lines[1:] if line is not None]
            continue
        angles = [2.0 * math.pi / order for order in ORDERS]
        turns += [
            (line, angle) for angle in angles if (line := surface.aligned(axis, angle)) is not None
        ]
    # any half turn about another axis turns it upside down; more of them would add nothing
    if revolutions:
        round_axis = revolutions[0]
        upside_down = [(line, math.pi) for line in revolutions[1:]] + [
            turn for turn in turns if turn[1] == math.pi
        ]
        turns = [(round_axis, 2.0 * math.pi / ROUND)]
        for (axis, point), angle in upside_down[:1]:  # about the nearest axis that is perpendicular
            across = axis - (axis @ round_axis.axis) * round_axis.axis
            turns.append((_Line(across / torch.linalg.vector_norm(across), point), angle))
    R = _group([rotation_from_axis_angle(angle * line.axis) for line, angle in turns])
    fixed = torch.from_numpy(centre) + radius * _common_point([line for line, _ in turns])
    transforms = torch.eye(4, dtype=torch.float64).repeat(len(R), 1, 1)
    transforms[:, :3, :3] = R
    transforms[:, :3, 3] = fixed - R @ fixed
    return transforms


def feature_fractions(mesh: trimesh.Trimesh, symmetries: Tensor) -> Tensor:
    """(S,) fraction of a mesh's surface that symmetries (S, 4, 4) of its shape move off the surface
    by more than the tolerance of :func:`mesh_symmetries`: small features, which differ between the
    poses that count as one.

    Example:
        >>> box = trimesh.creation.box((1, 2, 3))
        >>> feature_fractions(box, mesh_symmetries(box)).tolist()
        [0.0, 0.0, 0.0, 0.0]
    """
    cloud = surface_points(mesh, POINTS)
    tree = cKDTree(cloud)
    some = cloud[:: POINTS // FEATURE_POINTS]
    tolerance = FEATURE_HEIGHT * mesh_radius(mesh)
    fractions = [
        float((~are_near(tree, some @ S[:3, :3].T + S[:3, 3], tolerance)).mean())
        for S in symmetries.double().numpy()
    ]
    return torch.tensor(fractions, dtype=torch.float64)


class _Line(NamedTuple):
    """An axis of rotation: a unit vector (3,) and a point (3,) on it."""

    axis: Tensor
    point: Tensor


def _common_point(lines: Sequence[_Line]) -> Tensor:
    """(3,) point nearest to all lines, and among such points to the origin; the origin without
    lines."""
    if not lines:
        return torch.zeros(3, dtype=torch.float64)
    across = torch.stack(
        [torch.eye(3, dtype=torch.float64) - torch.outer(line.axis, line.axis) for line in lines]
    )
    points = torch.stack([line.point for line in lines])
    point: Tensor = (
        torch.linalg.pinv(across.sum(dim=0), rtol=1e-3)
        @ (across @ points[..., None]).sum(dim=0)[:, 0]
    )
    return point


class _Surface:
    """Points (N, 3) of a surface whose radius is 1, near the origin."""

    def __init__(self, cloud: Floats) -> None:
        self.cloud = cloud
        self._tree = cKDTree(cloud)
        self._some = cloud[:: POINTS // TESTED]

    def aligned(self, axis: Tensor, angle: float) -> _Line | None:
        """The axis near a given one through the origin about which a rotation leaves the shape as
        it is, if any."""
        R = start = rotation_from_axis_angle(angle * axis).numpy()
        t = np.zeros(3)
        points = self._some[:: TESTED // ALIGNED_POINTS]
        for _ in range(ALIGNMENT_STEPS):
            R, t, apart = rigid_step(self._tree, points, points @ R.T + t, ALIGNED_FRACTION)
            if apart > NEAR_SYMMETRY:
                return None
        if np.trace(R @ start.T) < 1.0 + 2.0 * math.cos(math.radians(MAX_TILT)):
            return None
        if are_near(self._tree, self._some @ R.T + t, TOLERANCE).mean() < FRACTION:
            return None
        return _Line(*map(torch.from_numpy, axis_of(R, t, axis.numpy())))


def _axes(cloud: Floats) -> list[Tensor]:
    """Unit axes of the file, and the principal axes of the surface that are well defined and differ
    from them."""
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
            if traces.max() < NEARLY_EQUAL and len(members) < LARGEST_GROUP:
                members.append(product)
    return torch.stack(members)
