"""The files that a mesh consists of: read, listed and digested through one resolver."""

import contextlib
import logging
import urllib.parse
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any

import trimesh

from ...errors import MeshError
from ...limits import MAX_MESH_BYTES
from ...utils.digests import file_digest, text_digest
from .gltf import check_gltf
from .polygon_files import with_triangles

__all__ = ["mesh_digest", "mesh_files", "read_mesh"]

_NAME_OTHER_FILES = (".glb", ".gltf", ".obj", ".ply")
"""Formats whose files may name buffers, material files or textures beside them."""


def mesh_files(path: Path) -> list[Path]:
    """The mesh file and every file that reading it asks for: buffers and images of glTF, MTL files, textures.

    They are found by reading the mesh, so that this list and what is read cannot differ. Of a mesh that cannot be read
    they are those asked for until it failed. Files that are named but missing are listed too: they change the mesh once
    they are there.

    Args:
        path: a mesh; any other file is listed alone.
    """
    folder = _Folder(path)
    if path.suffix.lower() in _NAME_OTHER_FILES and path.is_file():
        with contextlib.suppress(MeshError):  # reported where the mesh is loaded
            _read(path, folder)
    return [path, *sorted(folder.asked)]


def mesh_digest(path: Path) -> str:
    """16 hexadecimal digits of the contents of :func:`mesh_files`, wherever they lie.

    A file that is missing or cannot be read counts too, so that the digest changes once it is put right.
    """
    return text_digest(" ".join(map(file_digest, mesh_files(path))))


def read_mesh(path: Path) -> Any:
    """What trimesh makes of a mesh file and of the files that it names.

    Raises:
        MeshError: it cannot be read, or claims more than :mod:`curvireg_torch.limits` allow.
    """
    return _read(path, _Folder(path))


def _read(path: Path, folder: "_Folder") -> Any:
    suffix = path.suffix.lower()
    logger = logging.getLogger("trimesh")
    level = logger.level
    try:
        logger.setLevel(logging.CRITICAL)  # its tracebacks of files that it cannot read
        if path.stat().st_size > MAX_MESH_BYTES:
            raise ValueError(f"larger than {MAX_MESH_BYTES:,} bytes")
        data = path.read_bytes()
        if suffix in (".obj", ".off", ".ply"):
            data = with_triangles(data, suffix)
        elif suffix in (".glb", ".gltf"):
            check_gltf(data, suffix, folder.size)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy's, of numbers that the checks in as_mesh find
            return trimesh.load(BytesIO(data), file_type=suffix[1:], resolver=folder, process=False)
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".removeprefix("ValueError: ").split())[:300]
        raise MeshError(f"{path}: cannot be read as a mesh ({reason}); re-export the file") from error
    finally:
        logger.setLevel(level)


class _Folder(trimesh.resolvers.Resolver):  # type: ignore[misc]
    """Files beside a mesh, which it may name; no others, and nothing from the network.

    Attributes:
        asked: the files in this folder that were asked for, whether they exist or not.
    """

    def __init__(self, path: Path) -> None:
        self.folder, self.file_name = path.parent.resolve(), path.name
        self.asked: set[Path] = set()

    def _path(self, name: str) -> Path:
        path = (self.folder / urllib.parse.unquote(name)).resolve()
        if "://" not in name and path.is_relative_to(self.folder):
            self.asked.add(path)
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
