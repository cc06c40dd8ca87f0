"""Faces of more than three corners, divided into triangles."""

import numpy as np
from numpy.typing import NDArray

from ...limits import MAX_POLYGON_CORNERS

__all__ = ["ear_work", "triangulate"]

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


def triangulate(polygons: Floats) -> Indices:
    """Triangles that cover N planar polygons of n corners each, concave ones too.

    Convex polygons become fans; of the others ears are cut off. Corners may repeat (a hole joined to the rim by a
    bridge). A polygon that crosses itself gives some triangles.

    Args:
        polygons: (N, n, 3) corners in order, n >= 3.

    Returns:
        (N, n - 2, 3) numbers of corners, in the polygon's sense of rotation.

    Raises:
        ValueError: a concave polygon has more than ``MAX_POLYGON_CORNERS`` corners.

    Example:
        >>> dart = np.array([[[0.0, 0, 0], [1, 2, 0], [0, 1, 0], [-1, 2, 0]]])
        >>> sorted(map(sorted, triangulate(dart)[0].tolist()))
        [[0, 1, 2], [0, 2, 3]]
    """
    N, n, _ = polygons.shape
    ones = np.arange(1, n - 1)
    triangles = np.tile(np.stack([0 * ones, ones, ones + 1], axis=-1), (N, 1, 1))
    flat = _flattened(polygons)
    concave = ~_convex(flat)
    if n > 3 and concave.any():
        if n > MAX_POLYGON_CORNERS:
            raise ValueError(f"a concave face of {n} corners, more than {MAX_POLYGON_CORNERS}; triangulate the mesh")
        triangles[concave] = _cut_ears(flat[concave])
    return triangles


def ear_work(polygons: Floats) -> int:
    """Squared corners of those of N polygons that are not convex: what :func:`triangulate` takes time with.

    Example:
        >>> ear_work(np.array([[[0.0, 0, 0], [1, 2, 0], [0, 1, 0], [-1, 2, 0]]] * 3))
        48
    """
    n = polygons.shape[1]
    return n * n * int((~_convex(_flattened(polygons))).sum()) if n > 3 else 0


def _flattened(polygons: Floats) -> Floats:
    """(N, n, 2) corners without the coordinate that the plane is steepest in, anticlockwise."""
    points = polygons - polygons[:, :1]
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    axis = np.abs(normal).argmax(axis=1)[:, None]
    flat = np.stack([np.take_along_axis(points, (axis + i)[..., None] % 3, axis=2)[..., 0] for i in (1, 2)], axis=-1)
    flat[..., 0] *= np.where(np.take_along_axis(normal, axis, axis=1) < 0, -1.0, 1.0)
    return flat


def _cross(a: Floats, b: Floats) -> Floats:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _convex(flat: Floats) -> NDArray[np.bool_]:
    edges = np.roll(flat, -1, axis=1) - flat
    size = np.square(np.ptp(flat, axis=1)).sum(axis=1)
    bend: Floats = _cross(edges, np.roll(edges, -1, axis=1)).min(axis=1)
    flag: NDArray[np.bool_] = bend >= -1e-9 * size
    return flag


def _cut_ears(flat: Floats) -> Indices:
    """Triangles of polygons that wind anticlockwise, all of them one corner at a time."""
    N, n, _ = flat.shape
    size = np.square(np.ptp(flat, axis=1)).sum(axis=1)
    after = np.tile((np.arange(n) + 1) % n, (N, 1))
    before = np.tile((np.arange(n) - 1) % n, (N, 1))
    alive, waiting = np.ones((N, n), dtype=bool), np.ones((N, n), dtype=bool)  # a corner waits until it is looked at
    blocker = np.full((N, n), -1)  # what lies in a refused corner's triangle; when it goes, the corner waits again
    corner, cut = np.zeros(N, dtype=np.int64), np.zeros(N, dtype=np.int64)
    triangles = np.empty((N, n - 2, 3), dtype=np.int64)
    rows = np.arange(N)
    while len(rows):
        candidates = waiting[rows]
        crosses_itself = ~candidates.any(axis=1)
        candidates[crosses_itself] = alive[rows[crosses_itself]]
        ahead = (np.arange(n) - corner[rows, None]) % n  # the next one from where we are
        b = np.where(candidates, ahead, n).argmin(axis=1)
        a, c = before[rows, b], after[rows, b]
        A, B, C = (flat[rows, i][:, None] for i in (a, b, c))
        points, inside = flat[rows], alive[rows]
        for start, stop in ((A, B), (B, C), (C, A)):
            inside &= (_cross(stop - start, points - start) >= 0) & (points != start).any(axis=-1)
        bend = _cross(B - A, C - B)[:, 0] / size[rows]
        bent = bend > 1e-12
        ear = crosses_itself | (np.abs(bend) <= 1e-12) | (bent & ~inside.any(axis=1))
        waiting[rows, b] = False
        blocker[rows, b] = np.where(bent, inside.argmax(axis=1), -1)
        corner[rows] = b
        done, a, b, c = rows[ear], a[ear], b[ear], c[ear]
        triangles[done, cut[done]] = np.stack([a, b, c], axis=-1)
        after[done, a], before[done, c] = c, a
        alive[done, b] = False
        waiting[done] |= blocker[done] == b[:, None]
        waiting[done, a] = waiting[done, c] = True
        waiting[done] &= alive[done]
        corner[done] = after[done, c]  # leaving one out makes fewer slivers
        cut[done] += 1
        rows = rows[cut[rows] < n - 2]
    return triangles
