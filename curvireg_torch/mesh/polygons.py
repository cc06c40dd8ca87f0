"""Division of faces with more than three corners into triangles.

Readers, trimesh's too, divide such faces into fans, which is wrong for concave faces. Here those go to earcut.
"""

from collections import defaultdict
from collections.abc import Iterator

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from ..errors import MAX_MESH_FACES, MAX_MESH_LINES, MAX_POLYGON_CORNERS, MAX_POLYGON_WORK

Floats = NDArray[np.float64]


def check_face_count(count: int) -> None:
    """Raise ValueError for more faces than a mesh may have."""
    if count > MAX_MESH_FACES:
        raise ValueError(f"more than {MAX_MESH_FACES:,} faces; simplify it")


def check_line_count(data: bytes) -> None:
    """Raise ValueError for a text of more lines than a mesh file may have."""
    if max(data.count(b"\n"), data.count(b"\r")) > MAX_MESH_LINES:
        raise ValueError(f"more than {MAX_MESH_LINES:,} lines; simplify it")


def divide_faces(vertices: Floats, faces: list[list[int]]) -> Iterator[tuple[int, list[list[int]]]]:
    """Yield the index of each face of three or more corners, and its triangles as indices of its corners.

    Raises:
        ValueError: a vertex does not exist, or the faces are beyond :mod:`curvireg_torch.errors`.
    """
    check_face_count(sum(max(len(face) - 2, 0) for face in faces))
    by_length, work = defaultdict(list), 0
    for index, face in enumerate(faces):
        by_length[len(face)].append(index)
        if face and not 0 <= min(face) <= max(face) < len(vertices):
            raise ValueError(f"face {index} names vertices that do not exist")
    for corners, indices in by_length.items():
        if corners >= 3:
            polygons = vertices[np.array([faces[index] for index in indices])]
            work += corners**2 * int(_is_concave(_project(polygons)).sum())
            if work > MAX_POLYGON_WORK:
                raise ValueError("faces that are not convex have too many corners; triangulate the mesh")
            yield from zip(indices, triangulate(polygons), strict=True)


def triangulate(polygons: Floats) -> list[list[list[int]]]:
    """Triangles, as indices of corners, that cover each of (N, n, 3) planar polygons in the polygon's orientation.

    Convex polygons become fans. Corners may repeat, as where a bridge joins a hole to the outline. A polygon has n - 2
    triangles unless it crosses itself.

    Raises:
        ValueError: a concave polygon has more than ``MAX_POLYGON_CORNERS`` corners.

    Example:
        >>> dart = np.array([[[0.0, 0, 0], [1, 2, 0], [0, 1, 0], [-1, 2, 0]]])
        >>> sorted(map(sorted, triangulate(dart)[0]))
        [[0, 1, 2], [0, 2, 3]]
    """
    N, n, _ = polygons.shape
    triangles = [[[0, i, i + 1] for i in range(1, n - 1)]] * N
    flat = _project(polygons)
    concave = _is_concave(flat) & np.isfinite(flat).all(axis=(1, 2))  # as_mesh refuses the others, corner by corner
    if concave.any() and n > MAX_POLYGON_CORNERS:
        raise ValueError(f"a concave face of {n} corners, more than {MAX_POLYGON_CORNERS}; triangulate the mesh")
    for i in concave.nonzero()[0]:
        indices = mapbox_earcut.triangulate_float64(flat[i], np.array([n], dtype=np.uint32))
        if len(indices):
            triangles[i] = _with_all_corners(indices.reshape(-1, 3).tolist(), n)
    return triangles


def _with_all_corners(triangles: list[list[int]], n: int) -> list[list[int]]:
    """Put back the corners on straight edges, which earcut drops, so that faces still share edges with neighbours."""
    if len(triangles) >= n - 2:
        return triangles
    used = sorted({corner for triangle in triangles for corner in triangle})
    following = dict(zip(used, [*used[1:], used[0]], strict=True))
    ahead, complete = triangles, []
    while ahead:
        a, b, c = ahead.pop()
        for start, end, tip in ((a, b, c), (b, c, a), (c, a, b)):
            if following[start] == end and (end - start) % n > 1:
                middle = (start + 1) % n
                following[start], following[middle] = middle, end
                ahead += [[start, middle, tip], [middle, end, tip]]
                break
        else:
            complete.append([a, b, c])
    return complete


def _project(polygons: Floats) -> Floats:
    """(N, n, 2) corners without the coordinate along which the plane is steepest, anticlockwise."""
    points = polygons - polygons[:, :1]
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    axis = np.abs(normal).argmax(axis=1)[:, None]
    flat = np.stack([np.take_along_axis(points, (axis + i)[..., None] % 3, axis=2)[..., 0] for i in (1, 2)], axis=-1)
    flat[..., 0] *= np.where(np.take_along_axis(normal, axis, axis=1) < 0, -1.0, 1.0)
    return flat


def _is_concave(flat: Floats) -> NDArray[np.bool_]:
    """(N,): whether some corner of an anticlockwise polygon turns clockwise; True for polygons with NaN."""
    if flat.shape[1] <= 3:
        return np.zeros(len(flat), dtype=bool)
    edges = np.roll(flat, -1, axis=1) - flat
    ahead = np.roll(edges, -1, axis=1)
    size = np.square(np.ptp(flat, axis=1)).sum(axis=1)
    least_turn = (edges[..., 0] * ahead[..., 1] - edges[..., 1] * ahead[..., 0]).min(axis=1)
    return np.asarray(~(least_turn >= -1e-9 * size), dtype=bool)
