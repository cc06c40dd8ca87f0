"""The axis about which the shape of a mesh is nearly a body of revolution."""

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

# Points of the surface that are compared with, and those that are turned
POINTS = 20_000
TURNED = 1_000
# Relative difference of the two moments across an axis up to which a shape may be round about it,
# and difference from which the third one tells the axis
EQUAL_MOMENTS = 0.25
DEFINED = 0.05
# Angles in rad that a shape is turned by, and the distance in radii within which a point lands on
# the surface
ANGLES = (1.0, 2.3, 3.6, 5.0)
TOLERANCE = 0.04
# Fraction of the surface that lands on it, from which a shape is nearly round. A lid with a hole
# and a canister with two ports have 0.93 to 0.98, a mug with its handle 0.8
NEARLY_ROUND = 0.9
# and, upside down, on itself: the axis has no direction
SAME_ENDS = 0.975
STEPS = 6  # of the alignment
TRUSTED = 0.8  # fraction of the points that it trusts


class RoundAxis(NamedTuple):
    """An axis of a mesh: a unit vector (3,) along it, a point (3,) on it, both in the model's
    frame, and whether its ends look the same, so that it has no direction."""

    direction: Tensor
    point: Tensor
    ends_are_alike: bool


@measure
def round_axis(mesh: trimesh.Trimesh) -> RoundAxis | None:
    """The axis about which nine tenths of a mesh's surface are that of a body of revolution, as
    with a canister with ports or a cup with a hole in its lid; None if there is no such axis.

    Example:
        >>> axis = round_axis(trimesh.creation.cylinder(1.0, 3.0))
        >>> abs(axis.direction).round(decimals=2).tolist(), axis.ends_are_alike
        ([0.0, 0.0, 1.0], True)
        >>> round_axis(trimesh.creation.box((1, 2, 3))) is None
        True
    """
    radius = mesh_radius(mesh)
    cloud = surface_points(mesh, POINTS)
    start = cloud.mean(axis=0)
    cloud = (cloud - start) / radius
    candidates = _candidates(cloud)
    if not candidates:
        return None
    tree = cKDTree(cloud)
    some = cloud[:: POINTS // TURNED]
    for direction in candidates:
        centre = np.zeros(3)
        for _ in range(STEPS):
            direction, centre = _aligned(tree, some, direction, centre)
        if all(_landing(tree, some, _turn(direction, a), centre) >= NEARLY_ROUND for a in ANGLES):
            break
    else:
        return None
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    heights = some @ direction
    middle = centre + direction * (0.5 * (heights.min() + heights.max()) - centre @ direction)
    if _landing(tree, some, _turn(across, ANGLES[0]), middle) >= NEARLY_ROUND:  # a sphere
        return None
    return RoundAxis(
        torch.from_numpy(direction),
        torch.from_numpy(start + radius * middle),
        _landing(tree, some, _turn(across, np.pi), middle) >= SAME_ENDS,
    )


def _candidates(cloud: Floats) -> list[Floats]:
    """Unit vectors (3,) about which a shape may be round: the principal axis across which the
    moments are nearly equal; where all are, the axes of the file."""
    moments, vectors = np.linalg.eigh(cloud.T @ cloud)
    gaps = np.diff(moments) / moments[2]
    if max(gaps) < DEFINED:
        return list(np.eye(3)[::-1])
    if min(gaps) > EQUAL_MOMENTS:
        return []
    direction = vectors[:, 2 if gaps[0] < gaps[1] else 0]
    return [direction * np.sign(direction[np.argmax(np.abs(direction))])]


def _turn(direction: Floats, angle: float) -> Floats:
    return rotation_from_axis_angle(angle * torch.from_numpy(direction)).numpy()


def _landing(tree: cKDTree, points: Floats, R: Floats, centre: Floats) -> float:
    """Fraction of points that land on the surface when they turn about a centre."""
    return float(are_near(tree, (points - centre) @ R.T + centre, TOLERANCE).mean())


def _aligned(
    tree: cKDTree, points: Floats, direction: Floats, centre: Floats
) -> tuple[Floats, Floats]:
    """The axis after a step that brings the turned points nearer to the surface: what a rigid
    motion that does so leaves in place, for each of the angles, and their mean."""
    directions = []
    shift = np.zeros(3)
    weight = np.zeros((3, 3))
    for angle in ANGLES:
        moved = (points - centre) @ _turn(direction, angle).T + centre
        R, t, _ = rigid_step(tree, points, moved, TRUSTED)
        axis, point = axis_of(R, t, direction)
        directions.append(axis)
        across = np.eye(3) - np.outer(axis, axis)
        weight += across
        shift += across @ point
    mean = np.mean(directions, axis=0)
    return mean / np.linalg.norm(mean), np.linalg.pinv(weight, rcond=1e-3) @ shift
