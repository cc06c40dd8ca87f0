"""OBJ, OFF and PLY files with faces of more than three corners, which trimesh divides into fans.

Fans are wrong for concave faces, which are divided by earcut here; see :func:`trimesh.geometry.triangulate_quads`.
"""

import re
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from ..errors import MAX_MESH_FACES, MAX_MESH_LINES, MAX_POLYGON_WORK

Triangles = list[list[list[int]]]
"""For each face its triangles, as positions among its corners."""

_UNUSUAL_OBJ = re.compile(
    rb"^(?:[ \t]+\S|(?:v|vt|vn|f)\t|f +(?:(?:[^ \t\r\n]+[ \t]+){3}[^ \t\r\n]"
    rb"|[^\r\n]*(?:[-#]|(?<=[ \t/])0+(?![^/ \t\r\n]))))",
    re.MULTILINE,
)
"""Lines that trimesh does not read, or reads wrongly: an indent, tabs, a comment after a face, and faces of more than
three corners, with indices that count back from the end, or with index 0."""


def divide_faces(vertices: NDArray[np.float64], faces: Sequence[Sequence[int]]) -> Triangles:
    """Triangles that cover planar faces: fans of convex ones, others by earcut. Corners on straight edges may drop out.

    Raises:
        ValueError: a vertex does not exist, or the faces are beyond :mod:`curvireg_torch.errors`.

    Example:
        >>> dart = np.array([[0.0, 0, 0], [1, 2, 0], [0, 1, 0], [-1, 2, 0]])
        >>> [sorted(map(sorted, triangles)) for triangles in divide_faces(dart, [[0, 1, 2, 3]])]
        [[[0, 1, 2], [0, 2, 3]]]
    """
    if sum(max(len(face) - 2, 0) for face in faces) > MAX_MESH_FACES:
        raise ValueError(f"more than {MAX_MESH_FACES:,} faces; simplify it")
    if any(not 0 <= min(face) <= max(face) < len(vertices) for face in faces if face):
        raise ValueError("a face names a vertex that does not exist")
    triangles = [[[0, i, i + 1] for i in range(1, len(face) - 1)] for face in faces]
    by_length, work = defaultdict(list), 0
    for index, face in enumerate(faces):
        by_length[len(face)].append(index)
    for n, indices in by_length.items():
        if n > 3:
            flat = _flattened(vertices[np.array([faces[index] for index in indices])])
            concave = _is_concave(flat).nonzero()[0]
            work += n**2 * len(concave)  # the time of earcut grows so
            if work > MAX_POLYGON_WORK:
                raise ValueError("faces that are not convex have too many corners; triangulate the mesh")
            for i in concave:
                corners = mapbox_earcut.triangulate_float64(flat[i], np.array([n], dtype=np.uint32))
                triangles[indices[i]] = corners.reshape(-1, 3).tolist() or triangles[indices[i]]
    return triangles


def _flattened(polygons: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, n, 2) corners without the coordinate along which the plane is steepest, anticlockwise."""
    points = polygons - polygons[:, :1]
    normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
    axis = np.abs(normal).argmax(axis=1)[:, None]
    flat = np.stack([np.take_along_axis(points, (axis + i)[..., None] % 3, axis=2)[..., 0] for i in (1, 2)], axis=-1)
    flat[..., 0] *= np.where(np.take_along_axis(normal, axis, axis=1) < 0, -1.0, 1.0)
    return flat


def _is_concave(flat: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,): whether some corner of an anticlockwise polygon turns clockwise; False with NaN, which as_mesh refuses."""
    edges = np.roll(flat, -1, axis=1) - flat
    ahead = np.roll(edges, -1, axis=1)
    size = np.square(np.ptp(flat, axis=1)).sum(axis=1)
    least_turn = (edges[..., 0] * ahead[..., 1] - edges[..., 1] * ahead[..., 0]).min(axis=1)
    return np.asarray(least_turn < -1e-9 * size, dtype=bool)


def check_lines(data: bytes) -> None:
    """Raise ValueError for a text of more lines than a mesh file may have."""
    if max(data.count(b"\n"), data.count(b"\r")) > MAX_MESH_LINES:
        raise ValueError(f"more than {MAX_MESH_LINES:,} lines; simplify it")


def obj_with_triangles(data: bytes) -> bytes:
    """The content of an OBJ file as trimesh reads it, every face a triangle; the same bytes if nothing is unusual."""
    data = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    if _UNUSUAL_OBJ.search(data) is None:
        return data
    lines = data.splitlines()
    vertices: list[list[bytes]] = []
    counts, corners_of = {b"v": 0, b"vt": 0, b"vn": 0}, {}
    for number, line in enumerate(lines):
        words = line.split(b"#")[0].split()
        key = words[0] if words else b""
        if key == b"v":
            vertices.append(words[1:4])
        if key in counts:
            counts[key] += 1
        if key in counts or key == b"f":
            lines[number] = b" ".join(words)
        if key == b"f":
            corners_of[number] = [_absolute(word, counts) for word in words[1:]]
    faces = [[int(corner.split(b"/")[0]) - 1 for corner in corners] for corners in corners_of.values()]
    divided = divide_faces(np.array(vertices, dtype=np.float64).reshape(-1, 3), faces)
    for (number, corners), triangles in zip(corners_of.items(), divided, strict=True):
        lines[number] = b"\n".join(b"f " + b" ".join(corners[i] for i in triangle) for triangle in triangles)
    return b"\n".join(line.lstrip() for line in lines) + b"\n"


def _absolute(corner: bytes, counts: dict[bytes, int]) -> bytes:
    """``v/vt/vn`` counted from 1; negative indices count back from the current line."""
    indices = [(int(i) if i else None, count) for i, count in zip(corner.split(b"/"), counts.values(), strict=False)]
    if any(i == 0 for i, _ in indices):
        raise ValueError("a face names vertex 0; OBJ files count from 1")
    return b"/".join(b"" if i is None else b"%d" % (count + 1 + i if i < 0 else i) for i, count in indices)


def off_with_triangles(data: bytes) -> bytes:
    """The content of an OFF file with every face a triangle; the same bytes if all are."""
    header, _, rest = re.sub(rb"#[^\r\n]*", b"", data).partition(b"OFF")
    lines = [line for line in rest.splitlines() if line.strip()]
    if len(header) > 16 or not lines:
        raise ValueError("not an OFF file")
    V, F = (int(n) for n in lines[0].split()[:2])
    if V < 0 or F < 0 or len(lines) < 1 + V + F:
        raise ValueError("the file ends too early")
    words = [line.split() for line in lines[1 + V : 1 + V + F]]
    if all(line[0] == b"3" for line in words):
        return data
    faces = [[int(n) for n in line[1 : 1 + int(line[0])]] for line in words]
    vertices = np.array([line.split()[:3] for line in lines[1 : 1 + V]], dtype=np.float64).reshape(-1, 3)
    divided = zip(faces, divide_faces(vertices, faces), strict=True)
    rows = [b"3 %d %d %d" % tuple(face[i] for i in one) for face, triangles in divided for one in triangles]
    return b"\n".join([b"OFF", b"%d %d 0" % (V, len(rows)), *lines[1 : 1 + V], *rows, b""])


def ply_with_triangles(mesh: Any) -> Any:
    """The mesh that trimesh read from a PLY file, its faces divided by :func:`divide_faces`."""
    elements: dict[str, dict[str, Any]] = mesh.metadata.get("_ply_raw", {})
    for name, element in elements.items():
        values = element.get("data")
        rows = list(values.values()) if isinstance(values, dict) else [values]
        if element["length"] and any(row is None or len(row) < element["length"] for row in rows):
            raise ValueError(f"the file ends before the last {name}")
    values = elements.get("face", {}).get("data")
    if values is None:
        return mesh
    names = list(values if isinstance(values, dict) else values.dtype.names)
    lists = values[next((name for name in ("vertex_indices", "vertex_index") if name in names), names[0])]
    if not isinstance(values, dict):  # binary: trimesh takes the first face's number of corners for that of all
        if (lists["f0"] != lists["f1"].shape[1]).any():
            raise ValueError("binary faces with different numbers of corners are not read; export triangles")
        lists = lists["f1"]
    if np.shape(lists)[1:] == (3,):
        return mesh
    vertices = np.column_stack([elements["vertex"]["data"][axis] for axis in "xyz"]).astype(np.float64)
    faces = [row.tolist() for row in lists]
    divided = divide_faces(vertices, faces)
    if mesh.visual.kind == "texture":  # trimesh's vertices are others, one for each texture coordinate
        if any(one[0] for triangles in divided for one in triangles):
            raise ValueError("concave faces with texture coordinates are not read from PLY files; export triangles")
        return mesh
    owner = np.repeat(np.arange(len(faces)), [len(triangles) for triangles in divided])
    triangles = [[face[i] for i in one] for face, parts in zip(faces, divided, strict=True) for one in parts]
    options = {}
    if {"red", "green", "blue"} <= set(names):
        options["face_colors"] = np.column_stack([values[name] for name in ("red", "green", "blue")])[owner]
    elif mesh.visual.kind == "vertex":
        options["vertex_colors"] = mesh.visual.vertex_colors
    return type(mesh)(vertices, np.array(triangles, np.int64).reshape(-1, 3), process=False, **options)
