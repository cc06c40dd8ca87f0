"""Mesh files: which reader reads which format, the files that a mesh names, and the digest of all
of them."""

import contextlib
import logging
import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import CurviregError, MeshError, MissingDependencyError, MissingFileError
from ...utils.aliases import PathName
from ...utils.choices import MESHES
from ...utils.files import file_digest, foreign_content, text_digest
from .cad import read_collada, read_step
from .gltf import read_gltf
from .limits import check_lines
from .obj import read_obj
from .ply import read_ply
from .polygons import triangulated
from .source import MeshSource, ReadMesh, plain_text
from .stl import read_stl
from .threemf import read_threemf
from .urdf import read_urdf
from .usd import read_usd

# it would print tracebacks of files that it cannot read
logging.getLogger("trimesh").addHandler(logging.NullHandler())
# First bytes of formats that no other has, and how their files are named
_MARKS = {
    b"ply\n": (".ply",),
    b"ply\r": (".ply",),
    b"glTF": (".glb", ".gltf"),
    b"ISO-10303-21": (".step", ".stp"),
}
# Formats whose files may name buffers, material files, textures or meshes beside them
_WITH_COMPANIONS = (".dae", ".glb", ".gltf", ".obj", ".ply", ".urdf", ".usd", ".usda", ".usdc")


def mesh_files(path: Path, *, textures: Iterable[Path] = ()) -> list[Path]:
    """The mesh file and those that it names, missing ones too: buffers and images of glTF, MTL
    files, textures, meshes of a URDF. They are found by reading the mesh; if that fails, those
    requested before are listed. Other files stand alone."""
    source = MeshSource(path, textures)
    if path.suffix.lower() in _WITH_COMPANIONS and path.is_file():
        with contextlib.suppress(CurviregError):  # reported where the mesh is loaded
            read_source(source)
    # by name: the order in which they are digested is the same in folders of other names
    return [path, *sorted(source.requested, key=lambda file: (file.name, file))]


def mesh_digest(path: Path, *, textures: Iterable[Path] = ()) -> str:
    """16 hexadecimal digits of the contents of :func:`mesh_files`, whatever their folder; missing
    files count too."""
    return text_digest(" ".join(map(file_digest, mesh_files(path, textures=textures))))


def read_mesh(
    path: PathName,
    *,
    link: str | None = None,
    textures: PathName | None = None,
) -> ReadMesh:
    """Read a mesh file: polygons become triangles, parts lie at their places, and nothing is
    rescaled, cleaned or checked for use.

    Args:
        path: a file of one of the formats of docs/formats.md, by its suffix.
        link: the link of a URDF whose mesh is read, in the link's frame; None: all links.
        textures: a further folder in which files are looked for that the mesh names.

    Raises:
        MissingFileError: the file, or the folder of textures, does not exist.
        MissingDependencyError: a package is needed for the format.
        MeshError: the file cannot be read, or is beyond :mod:`curvireg_torch.errors`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "triangle.obj")
        ...     _ = path.write_text("v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\n")
        ...     mesh = read_mesh(path)
        >>> mesh.faces.tolist(), mesh.colours, mesh.unit
        ([[0, 1, 2]], None, None)
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError("no such file; check the path of the mesh", subject=path)
    if path.suffix.lower() not in MESHES:
        raise MeshError(
            f"expected a mesh file ({', '.join(MESHES)}); convert it first", subject=path
        )
    check_textures(textures)
    source = MeshSource(path, [] if textures is None else [Path(textures)])
    found = read_source(source, link)
    return replace(found, warnings=tuple(source.warnings))


def check_textures(folder: PathName | None) -> None:
    """Refuse a folder of textures that does not exist."""
    if folder is not None and not Path(folder).is_dir():
        raise MissingFileError("no such folder; check the folder of the textures", subject=folder)


def read_source(source: MeshSource, link: str | None = None) -> ReadMesh:
    """Read a mesh file and the files that it names; :class:`MeshError` if that fails. What could
    not be used is in the ``warnings`` of the source. ``link`` is one of a URDF, of which all are
    read by default."""
    path = source.path
    suffix = path.suffix.lower()
    if link is not None and suffix != ".urdf":
        raise MeshError("only a URDF has links; leave the link out", subject=path)
    try:
        _check_start(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of values that as_mesh reports
            if suffix == ".urdf":
                return read_urdf(source, read_source, link)
            return READERS[suffix](source)
    except MissingDependencyError:
        raise  # it names the file
    except CurviregError as error:
        raise error.with_subject(path) from None
    except Exception as error:
        words = f"{type(error).__name__}: {error}".removeprefix("ValueError: ").split()
        reason = " ".join(words)[:300]
        if "unexpected length" in reason:  # what trimesh says of two mistakes
            reason = (
                "the file ends too early, or has binary faces with different numbers of corners: "
                "export triangles"
            )
        message = f"cannot be read as a mesh ({reason}); re-export the file"
        raise MeshError(message, subject=path) from error


def _check_start(path: Path) -> None:
    """Refuse a file that is none of a mesh, or one of another kind than its name says."""
    with path.open("rb") as file:
        start = file.read(200)
    foreign = foreign_content(start)
    if foreign is not None:
        raise MeshError(foreign)
    for mark, suffixes in _MARKS.items():
        if start.startswith(mark) and path.suffix.lower() not in suffixes:
            raise MeshError(
                f"holds a mesh of another kind than its name says; name it {suffixes[0]}"
            )


def _read_off(source: MeshSource) -> ReadMesh:
    """Read an OFF file; colours are left out."""
    data = plain_text(source.data())
    check_lines(data)
    header, _, rest = re.sub(rb"#[^\n]*+", b"", data).partition(b"OFF")
    lines = [line.split() for line in rest.splitlines() if line.strip()]
    if len(header) > 16 or not lines:
        raise ValueError("not an OFF file")
    if b"4" in header or b"n" in header:
        raise ValueError("its vertices have more than three coordinates; export three")
    V, F = map(int, lines[0][:2])
    points = lines[1 : 1 + V]
    rows = lines[1 + V : 1 + V + F]
    faces = [row[1 : 1 + int(row[0])] for row in rows]
    is_cut = len(lines) < 1 + V + F or (F > 0 and len(faces[-1]) < int(rows[-1][0]))
    if min(V, F) < 0 or is_cut:
        raise ValueError("the file ends too early")
    if b"C" in header or any(len(row) > 1 + int(row[0]) for row in rows):
        source.warn("material", "it has colours, which are not read; they are left out")
    vertices = np.array([point[:3] for point in points], np.float64).reshape(-1, 3)
    corners = np.array([word for face in faces for word in face], np.int64)
    picked, _ = triangulated(vertices, corners, np.array([*map(len, faces)], np.int64))
    return ReadMesh(vertices, corners[picked])


READERS: dict[str, Callable[[MeshSource], ReadMesh]] = {
    ".3mf": read_threemf,
    ".dae": read_collada,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".iges": read_step,
    ".igs": read_step,
    ".obj": read_obj,
    ".off": _read_off,
    ".ply": read_ply,
    ".step": read_step,
    ".stl": read_stl,
    ".stp": read_step,
    ".usd": read_usd,
    ".usda": read_usd,
    ".usdc": read_usd,
    ".usdz": read_usd,
}
