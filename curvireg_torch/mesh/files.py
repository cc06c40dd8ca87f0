"""The files of a mesh: read, listed and digested through one resolver."""

import contextlib
import logging
import struct
import urllib.parse
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import trimesh

from ..errors import MAX_MESH_BYTES, CurviregWarning, MeshError
from ..utils.files import file_digest, text_digest
from . import obj, off, ply
from .gltf import check_gltf

_WITH_COMPANIONS = (".glb", ".gltf", ".obj", ".ply")
"""Formats whose files may name buffers, material files or textures beside them."""

_POLYGON_FORMATS = {".obj": obj.with_triangles, ".off": off.with_triangles, ".ply": ply.with_triangles}


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

    Missing material files and textures are a :class:`CurviregWarning`.
    """
    folder = _Folder(path)
    content = _read(path, folder)
    if missing := sorted(file.name for file in folder.requested if not file.is_file()):
        message = f"{path}: {', '.join(missing)} is missing beside it; the mesh is shown without these colours"
        warnings.warn(message, CurviregWarning, stacklevel=3)
    return content


def with_triangles(data: bytes, suffix: str) -> bytes:
    """The content of an OBJ, OFF or PLY file with every face a triangle; ValueError if the file is damaged."""
    try:
        return _POLYGON_FORMATS[suffix](data)
    except (struct.error, IndexError) as error:
        raise ValueError("the file ends too early") from error


def _read(path: Path, folder: "_Folder") -> Any:
    suffix = path.suffix.lower()
    logger = logging.getLogger("trimesh")
    level = logger.level
    try:
        logger.setLevel(logging.CRITICAL)  # trimesh logs tracebacks of files that it cannot read
        if path.stat().st_size > MAX_MESH_BYTES:
            raise ValueError(f"larger than {MAX_MESH_BYTES:,} bytes")
        data = path.read_bytes()
        if suffix in _POLYGON_FORMATS:
            data = with_triangles(data, suffix)
        elif suffix in (".glb", ".gltf"):
            check_gltf(data, suffix, folder.size)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of values that as_mesh reports
            return trimesh.load(BytesIO(data), file_type=suffix[1:], resolver=folder, process=False)
    except IndexError as error:
        message = "cannot be read as a mesh (a face names a vertex that the file lacks); re-export the file"
        raise MeshError(message, subject=path) from error
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".removeprefix("ValueError: ").split())[:300]
        raise MeshError(f"cannot be read as a mesh ({reason}); re-export the file", subject=path) from error
    finally:
        logger.setLevel(level)


class _Folder(trimesh.resolvers.Resolver):  # type: ignore[misc]
    """Access to the files beside a mesh and in folders below; ``requested`` lists them, existing or not."""

    def __init__(self, path: Path) -> None:
        self.folder, self.file_name = path.parent.resolve(), path.name
        self.requested: set[Path] = set()

    def _path(self, name: str) -> Path:
        path = (self.folder / urllib.parse.unquote(name)).resolve()
        if "://" not in name and path.is_relative_to(self.folder):
            self.requested.add(path)
            if path.is_file():
                return path
        raise ValueError(f"it names {name[:100]!r}, which is no file of its folder")

    def size(self, name: str) -> int:
        return self._path(name).stat().st_size

    def get(self, key: str) -> bytes:
        if self.size(key) > MAX_MESH_BYTES:
            raise ValueError(f"{key[:100]!r} is larger than {MAX_MESH_BYTES:,} bytes")
        return self._path(key).read_bytes()

    def keys(self) -> list[str]:
        return []

    def write(self, name: str, data: Any) -> None:
        raise NotImplementedError

    def namespaced(self, namespace: str) -> "_Folder":
        raise NotImplementedError
