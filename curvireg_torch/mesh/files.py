"""Mesh files: read by trimesh, within limits; what it would read wrongly is rewritten before, or refused."""

import contextlib
import json
import logging
import struct
import urllib.parse
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import trimesh

from ..errors import (
    MAX_MESH_BYTES,
    MAX_MESH_FACES,
    MAX_MESH_PARTS,
    MAX_TABLE_BYTES,
    CurviregWarning,
    MeshError,
)
from ..utils.files import file_digest, text_digest
from .colours import colours_of_parts
from .polygons import check_lines, obj_with_triangles, off_with_triangles, ply_with_triangles

_WITH_COMPANIONS = (".glb", ".gltf", ".obj", ".ply")
"""Formats whose files may name buffers, material files or textures beside them."""

_READ_EXTENSIONS = ("KHR_materials_", "KHR_lights_", "KHR_animation_", "EXT_texture_webp")
"""Beginnings of glTF extensions that a file may require: they leave shape and colours alone, or trimesh reads them."""


def mesh_files(path: Path) -> list[Path]:
    """The mesh file and those that it names, missing ones too: buffers and images of glTF, MTL files, textures.

    They are found by reading the mesh; if that fails, those requested before are listed. Other files stand alone.
    """
    folder = _Folder(path)
    if path.suffix.lower() in _WITH_COMPANIONS and path.is_file():
        with contextlib.suppress(MeshError):  # reported where the mesh is loaded
            _read(path, folder)
    return [path, *sorted(folder.requested)]


def mesh_digest(path: Path) -> str:
    """16 hexadecimal digits of the contents of :func:`mesh_files`, whatever their folder; missing files count too."""
    return text_digest(" ".join(map(file_digest, mesh_files(path))))


def read_mesh(path: Path) -> Any:
    """Read a mesh file, and the files that it names, with trimesh; :class:`MeshError` if that fails.

    Colours are in ``metadata["colours"]`` of each part. Missing material files and textures are a
    :class:`CurviregWarning`.
    """
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
    logger = logging.getLogger("trimesh")
    level = logger.level
    try:
        logger.setLevel(logging.CRITICAL)  # trimesh logs tracebacks of files that it cannot read
        if path.stat().st_size > MAX_MESH_BYTES:
            raise ValueError(f"larger than {MAX_MESH_BYTES:,} bytes")
        data = path.read_bytes()
        if suffix in (".obj", ".off") or (suffix == ".ply" and b"ascii" in data[:100]):
            check_lines(data)
        if suffix == ".obj":
            data = obj_with_triangles(data)
        elif suffix == ".off":
            data = off_with_triangles(data)
        elif suffix in (".glb", ".gltf"):
            check_gltf(data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of values that as_mesh reports
            content = trimesh.load(BytesIO(data), file_type=suffix[1:], resolver=folder, process=False)
            return ply_with_triangles(content) if suffix == ".ply" else content
    except IndexError as error:
        message = "cannot be read as a mesh (a face names a vertex that the file lacks); re-export the file"
        raise MeshError(message, subject=path) from error
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".removeprefix("ValueError: ").split())[:300]
        if "unexpected length" in reason:  # what trimesh says of both
            reason = "the file ends too early, or has binary faces with different numbers of corners: export triangles"
        raise MeshError(f"cannot be read as a mesh ({reason}); re-export the file", subject=path) from error
    finally:
        logger.setLevel(level)


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
        if len(data) < 20:
            raise ValueError("the file ends too early")
        data = data[20 : 20 + struct.unpack_from("<I", data, 12)[0]]
    if len(data) > MAX_TABLE_BYTES:
        raise ValueError(f"its JSON is larger than {MAX_TABLE_BYTES:,} bytes")
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"its JSON is damaged ({error})") from None
    try:
        _check_extensions(tree)
        _check_sizes(tree)
        _check_nodes(tree)
    except (TypeError, AttributeError, KeyError, IndexError) as error:
        raise ValueError(f"not valid glTF ({type(error).__name__}: {error})") from error


def _check_extensions(tree: dict[str, Any]) -> None:
    if not str(tree["asset"]["version"]).startswith("2."):
        raise ValueError("only glTF version 2 is read; export version 2")
    names = [str(name) for name in tree.get("extensionsRequired", [])]
    names += [name for node in tree.get("nodes", []) for name in node.get("extensions", {}) if "instancing" in name]
    for name in names:
        if not name.startswith(_READ_EXTENSIONS):
            raise ValueError(f"it requires the glTF extension {name[:60]}, which is not read; export without it")


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

    def sizes(mesh: dict[str, Any]) -> tuple[int, int, int]:
        """Parts, vertices and faces of a mesh."""
        vertices, faces = 0, 0
        for part in mesh["primitives"]:
            n = max(map(count, part["attributes"].values()), default=0)
            corners = count(part["indices"]) if "indices" in part else n
            vertices, faces = vertices + n, faces + (corners if part.get("mode", 4) == 5 else corners // 3)
        return len(mesh["primitives"]), vertices, faces

    meshes = [sizes(mesh) for mesh in tree.get("meshes", [])]
    copies = [meshes[_natural(node["mesh"])] for node in tree.get("nodes", []) if "mesh" in node]
    for each in (meshes, copies):
        parts, vertices, faces = (sum(column) for column in zip((0, 0, 0), *each, strict=True))
        if parts > MAX_MESH_PARTS:
            raise ValueError(f"more than {MAX_MESH_PARTS:,} parts; join them")
        if max(vertices / 3, faces) > MAX_MESH_FACES:
            raise ValueError(f"more than {MAX_MESH_FACES:,} faces; simplify it")


def _check_nodes(tree: dict[str, Any]) -> None:
    """Every node must be the child of one node at most, and a root of none: else the nodes form a circle, or more."""
    nodes, scenes = tree.get("nodes", []), tree.get("scenes", [])
    named = [child for node in nodes for child in node.get("children", [])]
    named += scenes[_natural(tree.get("scene", 0))].get("nodes", []) if scenes else []
    if len(set(map(_natural, named))) < len(named) or max(named, default=-1) >= len(nodes):
        raise ValueError("a node is missing, or the child of several; or the nodes form a circle")
