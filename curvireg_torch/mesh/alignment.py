"""What axes of symmetry and of revolution share: which points of a surface a motion leaves on it,
and the motion that brings more of them there."""

import numpy as np
from scipy.spatial import cKDTree

from ..utils.arrays import Flags, Floats


def are_near(tree: cKDTree, points: Floats, tolerance: float) -> Flags:
    """(N,): which of the points (N, 3) are within a distance of those of a tree."""
    distance, _ = tree.query(points, distance_upper_bound=tolerance)
    return np.asarray(np.isfinite(distance))


def rigid_step(
    tree: cKDTree, points: Floats, moved: Floats, trusted: float
) -> tuple[Floats, Floats, float]:
    """A step of ICP: the rotation (3, 3) and the translation (3,) that bring points (N, 3) nearest
    to those of a tree which are next to them where they were ``moved`` before; and how far away
    these were on average. Of the points a fraction is ``trusted``, the nearest ones."""
    distance, nearest = tree.query(moved)
    near = distance <= np.quantile(distance, trusted)
    source = points[near]
    target = tree.data[nearest[near]]
    from_mean = source.mean(axis=0)
    to_mean = target.mean(axis=0)
    U, _, V = np.linalg.svd((source - from_mean).T @ (target - to_mean))
    V[2] *= np.sign(np.linalg.det(U @ V))
    R = (U @ V).T
    return R, to_mean - R @ from_mean, float(distance[near].mean())


def axis_of(R: Floats, t: Floats, along: Floats) -> tuple[Floats, Floats]:
    """What a motion leaves in place: the unit vector (3,) of its axis, which points as ``along``,
    and the point (3,) on it that is nearest to the origin, which solves (1 - R) x = t across it."""
    vectors, _, _ = np.linalg.svd(np.eye(3) - R.T)
    axis = vectors[:, 2]
    return axis * np.sign(axis @ along), np.linalg.pinv(np.eye(3) - R, rcond=1e-3) @ t
