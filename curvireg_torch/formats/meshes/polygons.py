"""Planar faces of more than three corners become triangles.

trimesh 5.2 makes a fan of every polygon, which fills concave ones. Once concave.obj of
scripts/upstream has an area of 3, and OFF and PLY too, this can go.
"""

import mapbox_earcut
import numpy as np

from ...errors import MAX_POLYGON_WORK
from ...utils.arrays import Array, Floats, Integers
from .limits import check_corners, check_faces


def triangulated(
    vertices: Floats, corners: Integers, counts: Integers
) -> tuple[Integers, Integers]:
    """Triangles that cover planar polygons: fans of convex ones, others by earcut. Corners on
    straight edges may drop out.

    Args:
        vertices: (V, 3).
        corners: (N,) vertices of the polygons, one polygon after the other.
        counts: (P,) how many corners each polygon has.

    Returns:
        (T, 3) which of the N corners the triangles have, and (T,) the polygons that they are of,
        in their order.

    Raises:
        ValueError: a vertex does not exist, or the polygons are beyond
            :mod:`curvireg_torch.errors`.
    """
    check_faces(np.maximum(counts - 2, 0).sum())
    check_corners(corners, len(vertices))
    starts = np.cumsum(counts) - counts
    by_count = np.argsort(counts, kind="stable")
    sizes, bounds = np.unique(counts[by_count], return_index=True)
    triangles = [np.zeros((0, 3), np.int64)]
    owners = [np.zeros(0, np.int64)]
    work = 0
    for n, polygons in zip(sizes, np.split(by_count, bounds[1:]), strict=False):
        if n > 3:
            flat = _flattened(vertices[corners[starts[polygons][:, None] + np.arange(n)]])
            concave = _is_concave(flat)
            work += n**2 * concave.sum()  # the time of earcut grows so
            if work > MAX_POLYGON_WORK:
                raise ValueError(
                    "faces that are not convex have too many corners; triangulate the mesh"
                )
            for polygon, outline in zip(polygons[concave], flat[concave], strict=True):
                places = _ears(outline)
                triangles.append(starts[polygon] + places)
                owners.append(np.full(len(places), polygon))
            polygons = polygons[~concave]
        if n > 2:
            triangles.append((starts[polygons][:, None, None] + _fan(n)).reshape(-1, 3))
            owners.append(np.repeat(polygons, n - 2))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order]


def _fan(n: int) -> Integers:
    """(n - 2, 3) corners of the triangles of a convex polygon."""
    return np.column_stack([np.zeros(n - 2, np.int64), np.arange(1, n - 1), np.arange(2, n)])


def _ears(outline: Floats) -> Integers:
    """(T, 3) corners of the triangles of a polygon (n, 2) of any shape."""
    ears = mapbox_earcut.triangulate_float64(outline, np.array([len(outline)], np.uint32))
    return ears.reshape(-1, 3).astype(np.int64) if len(ears) else _fan(len(outline))


def _flattened(polygons: Floats) -> Floats:
    """(N, n, 2) projections of polygons (N, n, 3) along the axis nearest to the normal, all
    anticlockwise."""
    points = polygons - polygons[:, :1]
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    rows = np.arange(len(points))
    axis = np.abs(normal).argmax(axis=1)
    flat = np.stack([points[rows, :, (axis + i) % 3] for i in (1, 2)], axis=-1)
    flat[normal[rows, axis] < 0, :, 0] *= -1.0
    return flat


def _is_concave(flat: Floats) -> Array:
    """(N,): whether some corner of an anticlockwise polygon turns clockwise; False with NaN, which
    as_mesh refuses."""
    edges = np.roll(flat, -1, axis=1) - flat
    ahead = np.roll(edges, -1, axis=1)
    size = np.square(np.ptp(flat, axis=1)).sum(axis=1)
    least_turn = (edges[..., 0] * ahead[..., 1] - edges[..., 1] * ahead[..., 0]).min(axis=1)
    return np.asarray(least_turn < -1e-9 * size, dtype=bool)
