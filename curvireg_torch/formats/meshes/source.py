"""What readers of mesh files share: access to the files that a mesh names, its textures, and its
warnings."""

import os
from collections.abc import Callable, Iterable, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import MAX_MESH_BYTES, MAX_MESH_PARTS, MAX_TEXTURE_PIXELS
from ...utils.arrays import Bytes, Floats, Integers
from ...utils.choices import unit_of_length
from .colours import SurfaceColours, texture_pixels
from .limits import check_corners

MOST_WARNINGS = 5  # Of one kind
# Bytes and parts of a file's name, and bytes of each part: no longer one is that of a file
MAX_NAME_BYTES = 4096
MAX_NAME_PARTS = 64
MAX_PART_BYTES = 255


@dataclass(frozen=True)
class MeshWarning:
    """What a mesh lacks, or what was changed in it; ``read_mesh`` returns
    them.

    Attributes:
        kind: "texture", "material", "stray", "skin", "precision", "cut", "link" or "parts".
        text: one sentence, without the name of the file.

    Example:
        >>> MeshWarning("colours", "the texture 'label.png' is missing").text
        "the texture 'label.png' is missing"
    """

    kind: str
    text: str


@dataclass
class ReadMesh:
    """A mesh as a reader returns it.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int64.
        colours: of its F faces; None without any.
        unit: the unit that the file itself states, a key of ``UNITS``.
        up: the axis that the file itself states, or its format prescribes.
        usual_unit: the unit of files of its format that state none; None where the format says
            nothing.
        warnings: what was left out of it.
    """

    vertices: Floats
    faces: Integers
    colours: SurfaceColours | None = None
    unit: str | None = None
    up: str | None = None
    usual_unit: str | None = None
    warnings: tuple[MeshWarning, ...] = ()

    @classmethod
    def of_surface(cls, mesh: Any, colours: SurfaceColours | None = None) -> "ReadMesh":
        """The triangles of a ``trimesh.Trimesh``."""
        return cls(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64), colours)

    def without_unused_vertices(self) -> "ReadMesh":
        """The same faces without the vertices that none of them names, so that copies stay in
        proportion to the faces, which are counted."""
        check_corners(self.faces, len(self.vertices))
        is_used = np.zeros(len(self.vertices), bool)
        is_used[self.faces] = True
        if is_used.all():
            return self
        number = np.cumsum(is_used) - 1
        return replace(self, vertices=self.vertices[is_used], faces=number[self.faces])

    def transformed(self, T: Floats) -> "ReadMesh":
        """The mesh at another place, by a (4, 4) affine transform; mirrored faces are turned
        over."""
        moved = replace(self, vertices=self.vertices @ T[:3, :3].T + T[:3, 3])
        return moved if np.linalg.det(T[:3, :3]) >= 0.0 else moved.turned_over()

    def turned_over(self) -> "ReadMesh":
        """The mesh with the other sides of its faces outside."""
        colours = self.colours
        if colours is not None:
            colours = replace(colours, corners=colours.corners[:, ::-1], uv=colours.uv[:, ::-1])
        return replace(self, faces=self.faces[:, ::-1], colours=colours)

    def in_unit_of(self, metres: float) -> "ReadMesh":
        """The mesh, whose unit has so many metres, in the unit of this length; in metres if it has
        no name."""
        if unit := unit_of_length(metres):
            return replace(self, unit=unit)
        return replace(self, vertices=self.vertices * metres, unit="m")

    @classmethod
    def joined(cls, parts: Sequence["ReadMesh"]) -> "ReadMesh":
        """One mesh of several, in one unit; parts without colours are white where others have
        some."""
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
        colours = None
        if any(part.colours is not None for part in parts):
            known = [part.colours or SurfaceColours.plain(len(part.faces)) for part in parts]
            colours = SurfaceColours.cat(known)
        return cls(
            np.concatenate([np.zeros((0, 3)), *(part.vertices for part in parts)]),
            np.concatenate([np.zeros((0, 3), np.int64), *faces]),
            colours,
        )


class MeshSource:
    """A mesh file and the files that it names: those in its folder and below, and in the folders
    ``extra``.

    Attributes:
        path: the mesh file.
        requested: files that the mesh named, existing or not.
        warnings: what was noticed while it was read.
    """

    def __init__(self, path: Path, extra: Iterable[Path] = ()) -> None:
        self.path = path
        self.folder = path.parent.resolve()
        self.extra = [folder.resolve() for folder in extra]
        self.requested: set[Path] = set()
        self.warnings: list[MeshWarning] = []
        self._bytes_left = MAX_MESH_BYTES
        self._pixels_left = MAX_TEXTURE_PIXELS
        self._textures: dict[object, Bytes | None] = {}
        self._known_places: dict[str, list[Path]] = {}
        self._listings: dict[Path, dict[str, str]] = {}

    def data(self) -> bytes:
        """The content of the mesh file."""
        if self.path.stat().st_size > MAX_MESH_BYTES:
            raise ValueError(f"larger than {MAX_MESH_BYTES:,} bytes")
        return self.path.read_bytes()

    def beside(self, path: Path) -> "MeshSource":
        """The source of another mesh file that this one names; what it requests and reads counts
        for this one."""
        other = MeshSource(path, [self.folder, *self.extra])
        other.requested = self.requested
        self._count_bytes(path)
        other._bytes_left = self._bytes_left
        return other

    def warn(self, kind: str, text: str) -> None:
        """Note a warning, once, and of each kind a few only."""
        same = [warning for warning in self.warnings if warning.kind == kind]
        if len(same) == MOST_WARNINGS:
            text = "and more of this kind"
        warning = MeshWarning(kind, text)
        if len(same) <= MOST_WARNINGS and warning not in same:
            self.warnings.append(warning)

    def has(self, name: str) -> bool:
        """Whether a name is that of a file that may be read, which is not thereby requested."""
        return any(map(self._existing, self._places(name)))

    def find(self, name: str) -> Path | None:
        """The file that a mesh names; None if it lies outside of the folders. It may not exist."""
        places = self._places(name)
        if not places:
            return None
        found = next(filter(None, map(self._existing, places)), places[0])
        self.requested.add(found)
        _check_names(self.requested)
        return found

    def _places(self, name: str) -> list[Path]:
        """Where in the folders a file of a name may be, existing or not; each name is looked for
        once, and of names of strangers a bounded number."""
        if name not in self._known_places:
            self._known_places[name] = self._places_of(name)
            _check_names(self._known_places)
        return self._known_places[name]

    def _places_of(self, name: str) -> list[Path]:
        """Backslashes separate folders too, and of absolute names the last part counts."""
        if "://" in name or not is_file_name(name):
            return []
        relative = name.replace("\\", "/")
        last = relative.rpartition("/")[2]
        if relative.startswith("/") or ":" in relative.partition("/")[0]:
            relative = last
        beside = self.folder / relative
        places = [(beside, self.folder)]
        for folder in self.extra:
            places += [(path, folder) for path in (beside, folder / relative, folder / last)]
        resolved = [(path.resolve(), folder) for path, folder in places]
        return [path for path, folder in resolved if path.is_relative_to(folder)]

    def read(self, name: str) -> bytes:
        """The content of a file that the mesh needs; ValueError where it cannot be had."""
        content = self._content(name)
        if content is None:
            raise ValueError(f"it names {name[:100]!r}, which is no file of its folder")
        return content

    def read_optional(self, kind: str, *names: str) -> bytes | None:
        """The content of the first of several spellings of a file's name that exists; None, with a
        warning."""
        for name in names:
            content = self._content(name)
            if content is not None:
                return content
        if not any(map(is_file_name, names)):
            problem = "is no name of a file, and is left out"
        elif any(self._places(name) for name in names):
            problem = "is missing beside it; the mesh is shown without these colours"
        else:
            problem = "lies outside of its folder and is left out; name its folder (textures)"
        self.warn(kind, f"{names[0][:100]} {problem}")
        return None

    def texture(
        self, key: object, read_content: Callable[[], bytes | None], name: str
    ) -> Bytes | None:
        """The pixels of a picture, read and decoded once for each ``key``; None, with a warning, if
        it cannot be used."""
        if key not in self._textures:
            content = read_content()
            self._textures[key] = None if content is None else self._decoded(content, name)
        return self._textures[key]

    def texture_file(self, *names: str) -> Bytes | None:
        """The pixels of a picture that is named in one of several spellings."""
        return self.texture(names, lambda: self.read_optional("texture", *names), names[0])

    def _decoded(self, content: bytes, name: str) -> Bytes | None:
        try:
            pixels, count = texture_pixels(content, self._pixels_left)
        except Exception as error:  # decoders raise anything
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            text = (
                f"the texture {name[:100]} cannot be used ({reason}); its faces are shown in "
                f"their plain colour"
            )
            self.warn("texture", text)
            return None
        self._pixels_left -= count
        return pixels

    def _content(self, name: str) -> bytes | None:
        path = self.find(name)
        if path is None or not path.is_file():
            return None
        self._count_bytes(path)
        return path.read_bytes()

    def _count_bytes(self, path: Path) -> None:
        self._bytes_left -= path.stat().st_size
        if self._bytes_left < 0:
            raise ValueError(f"the files that it names hold more than {MAX_MESH_BYTES:,} bytes")

    def _existing(self, path: Path) -> Path | None:
        """The file itself at one of the places, or one whose name differs in upper and lower case
        only."""
        if path.is_file():
            return path
        roots = [self.folder, *self.extra]
        place = next(folder for folder in roots if path.is_relative_to(folder))
        for part in path.relative_to(place).parts:
            name = self._names_in(place).get(part.lower())
            if name is None:
                return None
            place = (place / name).resolve()
        is_inside = any(place.is_relative_to(folder) for folder in roots)
        return place if is_inside and place.is_file() else None

    def _names_in(self, folder: Path) -> dict[str, str]:
        """Names of a folder by their lower case; of several the first in order."""
        if folder not in self._listings:
            names = sorted((path.name for path in folder.glob("*")), reverse=True)
            self._listings[folder] = {name.lower(): name for name in names}
        return self._listings[folder]


def _check_names(names: Sized) -> None:
    if len(names) > MAX_MESH_PARTS:
        raise ValueError(f"it names more than {MAX_MESH_PARTS:,} files")


def is_file_name(name: str) -> bool:
    """Whether a name can be that of a file: neither empty nor longer than systems allow."""
    try:
        encoded = os.fsencode(name)
    except UnicodeEncodeError:  # half of a pair of surrogates, as JSON can hold
        return False
    if len(encoded) > MAX_NAME_BYTES or b"\0" in encoded or not encoded.strip():
        return False
    parts = encoded.replace(b"\\", b"/").split(b"/")
    return len(parts) <= MAX_NAME_PARTS and max(map(len, parts)) <= MAX_PART_BYTES


def spellings(name: bytes) -> tuple[str, ...]:
    """A file's name in the encodings that exporters write."""
    found: dict[str, None] = {}
    for encoding in ("utf-8", "gb18030", "cp1252", "latin-1"):
        with suppress(UnicodeDecodeError):
            found[name.decode(encoding)] = None
    return tuple(found)


def plain_text(data: bytes) -> bytes:
    """A text file without byte-order mark, in an encoding that contains ASCII, with one kind of
    line end."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        data = data.decode("utf-16", errors="replace").encode()
    data = data.removeprefix(b"\xef\xbb\xbf")
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def colour_bytes(colours: Floats) -> Bytes:
    """Colours of vertices that a file writes as numbers, in 0..1 or in 0..255: whole numbers of
    which some are above 1, or numbers that mostly are, count as the latter. Beyond the range, as
    of highlights in linear colours, they are clipped; NaN is black."""
    known = np.nan_to_num(colours, posinf=255.0, neginf=0.0)
    bright = known[known > 0.0]
    is_whole = bool((known == known.round()).all()) and bright.max(initial=0.0) > 1.0
    is_in_bytes = is_whole or (bright.size > 0 and float(np.median(bright)) > 1.0)
    return np.clip((known * (1.0 if is_in_bytes else 255.0)).round(), 0, 255).astype(np.uint8)


def numbers(text: bytes) -> Floats:
    """Numbers between blanks; ValueError for anything else."""
    try:
        return np.array(text.split(), np.float64)
    except ValueError as error:
        if b"," in text:
            raise ValueError("decimal commas; export it with decimal points") from error
        raise ValueError("a coordinate is not a number") from error


def fixed_numbers(values: Any, count: int, default: Sequence[float] = ()) -> Floats:
    """(count,) finite numbers of a list, or between the blanks of a text; the default where
    None."""
    given = default if values is None else values
    found = np.asarray(given.split() if isinstance(given, str) else given, np.float64)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise ValueError(f"expected {count} numbers, got {values!r}"[:200])
    return found
