"""Mesh files: read by trimesh, within limits; what it would read wrongly is rewritten before, or refused.

trimesh divides faces of more than three corners into fans (:func:`trimesh.geometry.triangulate_quads`), which is wrong
for concave ones. In OBJ, OFF and PLY files those are divided by earcut here.
"""

import contextlib
import json
import logging
import re
import struct
import urllib.parse
import warnings
from collections import defaultdict
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import mapbox_earcut
import numpy as np
import trimesh
from numpy.typing import NDArray

from ..errors import (
    MAX_MESH_BYTES,
    MAX_MESH_FACES,
    MAX_MESH_LINES,
    MAX_MESH_PARTS,
    MAX_POLYGON_WORK,
    MAX_TABLE_BYTES,
    CurviregWarning,
    MeshError,
)
from ..utils.files import file_digest, text_digest
from .colours import colours_of_parts

# Formats whose files may name buffers, material files or textures beside them
_WITH_COMPANIONS = (".glb", ".gltf", ".obj", ".ply")
# Beginnings of glTF extensions that a file may require: they leave shape and colours alone, or trimesh reads them
_READ_EXTENSIONS = ("KHR_materials_", "KHR_lights_", "KHR_animation_", "EXT_texture_webp")
logging.getLogger("trimesh").addHandler(logging.NullHandler())  # it would print tracebacks of files that it cannot read
Triangles = list[list[list[int]]]  # For each face its triangles, as positions among its corners
# Lines that trimesh does not read, or reads wrongly: an indent, tabs, a comment after a face, and faces of more than
# three corners, with indices that count back from the end, or with index 0
_UNUSUAL_OBJ = re.compile(
    rb"^(?:[ \t]+\S|(?:v|vt|vn|f)\t|f +(?:(?:[^ \t\r\n]+[ \t]+){3}[^ \t\r\n]"
    rb"|[^\r\n]*(?:[-#]|(?<=[ \t/])0+(?![^/ \t\r\n]))))",
    re.MULTILINE,
)


def mesh_files(path: Path) -> list[Path]:
    """The mesh file and those that it names, missing ones too: buffers and images of glTF, MTL files, textures. They
    are found by reading the mesh; if that fails, those requested before are listed. Other files stand alone."""
    folder = _Folder(path)
    if path.suffix.lower() in _WITH_COMPANIONS and path.is_file():
        with contextlib.suppress(MeshError):  # reported where the mesh is loaded
            _read(path, folder)
    return [path, *sorted(folder.requested)]


def mesh_digest(path: Path) -> str:
    """16 hexadecimal digits of the contents of :func:`mesh_files`, whatever their folder; missing files count too."""
    return text_digest(" ".join(map(file_digest, mesh_files(path))))


def read_mesh(path: Path) -> Any:
    """Read a mesh file, and the files that it names, with trimesh; :class:`MeshError` if that fails. Colours are in
    ``metadata["colours"]`` of each part. Missing material files and textures are a :class:`CurviregWarning`."""
    folder = _Folder(path)
    content = _read(path, folder)
    if missing := sorted(file.name for file in folder.requested if not file.is_file()):
        message = f"{path}: {', '.join(missing)} is missing beside it; the mesh is shown without these colours"
        warnings.warn(message, CurviregWarning, stacklevel=3)
    parts = [part for part in getattr(content, "geometry", {"": content}).values() if isinstance(part, trimesh.Trimesh)]
    for part, colours in zip(parts, colours_of_parts(parts, close=True), strict=True):
        part.visual = trimesh.visual.ColorVisuals()
        part.metadata["colours"] = colours
    return content


def _read(path: Path, folder: "_Folder") -> Any:
    suffix = path.suffix.lower()
    try:
        if path.stat().st_size > MAX_MESH_BYTES:
            raise ValueError(f"larger than {MAX_MESH_BYTES:,} bytes")
        data = path.read_bytes()
        is_text = suffix in (".obj", ".off") or (suffix == ".ply" and b"ascii" in data[:100])
        if is_text and max(data.count(b"\n"), data.count(b"\r")) > MAX_MESH_LINES:
            raise ValueError(f"more than {MAX_MESH_LINES:,} lines; simplify it")
        if suffix == ".obj":
            data = obj_with_triangles(data)
        elif suffix == ".off":
            return _off_mesh(data)
        elif suffix in (".glb", ".gltf"):
            check_gltf(data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of values that as_mesh reports
            content = trimesh.load(BytesIO(data), file_type=suffix[1:], resolver=folder, process=False)
            return _ply_mesh(content) if suffix == ".ply" else content
    except IndexError as error:
        message = "cannot be read as a mesh (a face names a vertex that the file lacks); re-export the file"
        raise MeshError(message, subject=path) from error
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".removeprefix("ValueError: ").split())[:300]
        if "unexpected length" in reason:  # what trimesh says of both
            reason = "the file ends too early, or has binary faces with different numbers of corners: export triangles"
        raise MeshError(f"cannot be read as a mesh ({reason}); re-export the file", subject=path) from error


class _Folder(trimesh.resolvers.FilePathResolver):  # type: ignore[misc]
    """Access to the files beside a mesh and in folders below; ``requested`` lists them, existing or not."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._folder, self._bytes_left = path.parent.resolve(), MAX_MESH_BYTES
        self.requested: set[Path] = set()

    def get(self, name: str) -> bytes:
        path = (self._folder / urllib.parse.unquote(name)).resolve()
        if "://" not in name and path.is_relative_to(self._folder):
            self.requested.add(path)
            if path.is_file():
                self._bytes_left -= path.stat().st_size
                if self._bytes_left < 0:
                    raise ValueError(f"the files that it names hold more than {MAX_MESH_BYTES:,} bytes")
                return path.read_bytes()
        raise ValueError(f"it names {name[:100]!r}, which is no file of its folder")


def check_gltf(data: bytes) -> None:
    """Raise ValueError for glTF that trimesh would read wrongly, or for which it would take too much memory."""
    if data.startswith(b"glTF"):
        data = data[20 : 20 + struct.unpack_from("<I", data, 12)[0]]
    if len(data) > MAX_TABLE_BYTES:
        raise ValueError(f"its JSON is larger than {MAX_TABLE_BYTES:,} bytes")
    tree = json.loads(data)
    try:
        if not str(tree["asset"]["version"]).startswith("2."):
            raise ValueError("only glTF version 2 is read; export version 2")
        names = [str(name) for name in tree.get("extensionsRequired", [])]
        names += [name for node in tree.get("nodes", []) for name in node.get("extensions", {}) if "instancing" in name]
        for name in names:
            if not name.startswith(_READ_EXTENSIONS):
                raise ValueError(f"it requires the glTF extension {name[:60]}, which is not read; export without it")
        _check_sizes(tree)
        _check_nodes(tree)
    except (TypeError, AttributeError, KeyError, IndexError) as error:
        raise ValueError(f"not valid glTF ({type(error).__name__}: {error})") from error


def _natural(value: Any) -> int:
    """``value`` if it is an integer >= 0, as sizes and indices must be."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise TypeError(f"expected an integer >= 0, got {value!r}")
    return value


def _check_sizes(tree: dict[str, Any]) -> None:
    """Bounds on what trimesh copies: views of buffers, accessors, and every copy of a part."""
    accessors = tree.get("accessors", [])
    widths = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
    copied = sum(_natural(view["byteLength"]) for view in tree.get("bufferViews", []))
    claimed = sum(4 * widths[accessor["type"]] * _natural(accessor["count"]) for accessor in accessors)
    if max(copied, claimed) > 4 * MAX_MESH_BYTES:
        raise ValueError(f"its buffer views or accessors claim more than {4 * MAX_MESH_BYTES:,} bytes")

    def count(index: Any) -> int:
        accessor = accessors[_natural(index)]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError("an accessor of a part is sparse or without data, which is not read; export without it")
        return int(accessor["count"])

    def corners(part: dict[str, Any]) -> int:
        """Corners of the faces of a part, or its vertices if these are more."""
        used = [*part["attributes"].values(), *([part["indices"]] if "indices" in part else [])]
        return max(map(count, used), default=0)

    meshes = [(len(mesh["primitives"]), sum(map(corners, mesh["primitives"]))) for mesh in tree.get("meshes", [])]
    copies = [meshes[_natural(node["mesh"])] for node in tree.get("nodes", []) if "mesh" in node]
    for each in (meshes, copies):
        parts, most = (sum(column) for column in zip((0, 0), *each, strict=True))
        if parts > MAX_MESH_PARTS:
            raise ValueError(f"more than {MAX_MESH_PARTS:,} parts; join them")
        if most > 3 * MAX_MESH_FACES:
            raise ValueError(f"more than {MAX_MESH_FACES:,} faces; simplify it")


def _check_nodes(tree: dict[str, Any]) -> None:
    """Every node must be the child of one node at most, and a root of none: else the nodes form a circle, or more."""
    nodes, scenes = tree.get("nodes", []), tree.get("scenes", [])
    named = [child for node in nodes for child in node.get("children", [])]
    named += scenes[_natural(tree.get("scene", 0))].get("nodes", []) if scenes else []
    if len(set(map(_natural, named))) < len(named) or max(named, default=-1) >= len(nodes):
        raise ValueError("a node is missing, or the child of several; or the nodes form a circle")


def divide_faces(vertices: NDArray[np.float64], faces: Sequence[Sequence[int]]) -> Triangles:
    """Triangles that cover planar faces: fans of convex ones, others by earcut. Corners on straight edges may drop out.
    Raises ValueError where a vertex does not exist, or the faces are beyond :mod:`curvireg_torch.errors`."""
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


def _off_mesh(data: bytes) -> trimesh.Trimesh:
    header, _, rest = re.sub(rb"#[^\r\n]*", b"", data).partition(b"OFF")
    lines = [line.split() for line in rest.splitlines() if line.strip()]
    if len(header) > 16 or not lines:
        raise ValueError("not an OFF file")
    V, F = map(int, lines[0][:2])
    if V < 0 or F < 0 or len(lines) < 1 + V + F:
        raise ValueError("the file ends too early")
    vertices = np.array([line[:3] for line in lines[1 : 1 + V]], dtype=np.float64).reshape(-1, 3)
    faces = [list(map(int, line[1 : 1 + int(line[0])])) for line in lines[1 + V : 1 + V + F]]
    return trimesh.Trimesh(vertices, _triangles(vertices, faces)[0], process=False)


def _triangles(
    vertices: NDArray[np.float64], faces: Sequence[Sequence[int]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(T, 3) vertices of the triangles of :func:`divide_faces`, and (T,) the faces that they are of."""
    divided = divide_faces(vertices, faces)
    triangles = [[face[i] for i in one] for face, parts in zip(faces, divided, strict=True) for one in parts]
    return np.array(triangles, np.int64).reshape(-1, 3), np.repeat(np.arange(len(faces)), list(map(len, divided)))


def _ply_mesh(mesh: Any) -> Any:
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
    if mesh.visual.kind == "texture":  # trimesh's vertices are others, one for each texture coordinate
        if any(one[0] for triangles in divide_faces(vertices, faces) for one in triangles):
            raise ValueError("concave faces with texture coordinates are not read from PLY files; export triangles")
        return mesh
    triangles, owner = _triangles(vertices, faces)
    options = {}
    if {"red", "green", "blue"} <= set(names):
        options["face_colors"] = np.column_stack([values[name] for name in ("red", "green", "blue")])[owner]
    elif mesh.visual.kind == "vertex":
        options["vertex_colors"] = mesh.visual.vertex_colors
    return type(mesh)(vertices, triangles, process=False, **options)
