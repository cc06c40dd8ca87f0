"""Planar faces of more than three corners become triangles.

trimesh 5.2 makes a fan of every polygon, which fills concave ones. Once concave.obj of
scripts/upstream has an area of 3, and OFF and PLY too, this can go.
"""

from collections import defaultdict
from collections.abc import Sequence

import mapbox_earcut
import numpy as np

from ...errors import MAX_POLYGON_WORK
from ...utils.arrays import Array, Floats, Integers
from .limits import check_faces

Triangles = list[list[list[int]]]  # For each face its triangles, as positions among its corners


def divide_faces(vertices: Floats, faces: Sequence[Sequence[int]]) -> Triangles:
    """Triangles that cover planar faces: fans of convex ones, others by earcut. Corners on straight
    edges may drop out. Raises ValueError where a vertex does not exist, or the faces are beyond
    :mod:`curvireg_torch.errors`."""
    check_faces(sum(max(len(face) - 2, 0) for face in faces))
    if any(not 0 <= min(face) <= max(face) < len(vertices) for face in faces if face):
        raise ValueError("a face names a vertex that does not exist")
    triangles = [[[0, i, i + 1] for i in range(1, len(face) - 1)] for face in faces]
    by_length = defaultdict(list)
    work = 0
    for index, face in enumerate(faces):
        by_length[len(face)].append(index)
    for n, indices in by_length.items():
        if n > 3:
            flat = _flattened(vertices[np.array([faces[index] for index in indices])])
            concave = _is_concave(flat).nonzero()[0]
            work += n**2 * len(concave)  # the time of earcut grows so
            if work > MAX_POLYGON_WORK:
                raise ValueError(
                    "faces that are not convex have too many corners; triangulate the mesh"
                )
            for i in concave:
                corners = mapbox_earcut.triangulate_float64(flat[i], np.array([n], dtype=np.uint32))
                triangles[indices[i]] = corners.reshape(-1, 3).tolist() or triangles[indices[i]]
    return triangles


def _flattened(polygons: Floats) -> Floats:
    """(N, n, 2) corners without the coordinate along which the plane is steepest, anticlockwise."""
    points = polygons - polygons[:, :1]
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    axis = np.abs(normal).argmax(axis=1)[:, None]
    flat = np.stack(
        [np.take_along_axis(points, (axis + i)[..., None] % 3, axis=2)[..., 0] for i in (1, 2)],
        axis=-1,
    )
    flat[..., 0] *= np.where(np.take_along_axis(normal, axis, axis=1) < 0, -1.0, 1.0)
    return flat


def _is_concave(flat: Floats) -> Array:
    """(N,): whether some corner of an anticlockwise polygon turns clockwise; False with NaN, which
    as_mesh refuses."""
    edges = np.roll(flat, -1, axis=1) - flat
    ahead = np.roll(edges, -1, axis=1)
    size = np.square(np.ptp(flat, axis=1)).sum(axis=1)
    least_turn = (edges[..., 0] * ahead[..., 1] - edges[..., 1] * ahead[..., 0]).min(axis=1)
    return np.asarray(least_turn < -1e-9 * size, dtype=bool)


def triangles_of_faces(
    vertices: Floats, faces: Sequence[Sequence[int]]
) -> tuple[Integers, Integers, Integers]:
    """(T, 3) vertices of the triangles of :func:`divide_faces`, (T,) the faces that they are of,
    and (T, 3) which corners of these they have."""
    divided = divide_faces(vertices, faces)
    owner = np.repeat(np.arange(len(faces)), list(map(len, divided)))
    places = np.array([one for parts in divided for one in parts], np.int64).reshape(-1, 3)
    starts = np.cumsum([0, *map(len, faces)])[owner]
    corners = np.array([corner for face in faces for corner in face], np.int64)
    return corners[starts[:, None] + places], owner, places
