"""OBJ files and their material libraries, in time proportional to their size.

trimesh 5.2 counts negative indices from the end of the file, loses the first vertex behind a
byte-order mark, and refuses Latin-1. Once it reads negative.obj, bom.obj and concave.obj of
scripts/upstream, several libraries, and options of textures, this reader can go.
"""

import re
from dataclasses import dataclass, field
from itertools import takewhile

import numpy as np

from ...utils.arrays import Bytes, Floats, Integers
from .colours import Painting, SurfaceColours, byte_colours
from .limits import check_faces, check_lines, check_parts
from .polygons import triangles_of_faces
from .source import MeshSource, ReadMesh, colour_bytes, numbers, plain_text, spellings

CHUNK = 100_000  # Lines of faces that are read at once, which bounds the memory
# Corners of one form: v, v/vt and v/vt/vn. Possessive, so that no text takes long to be refused.
_FORMS = {
    fields: re.compile(rb"(?:\s++" + rb"/".join([rb"-?+\d++"] * fields) + rb")++\s*+")
    for fields in (1, 2, 3)
}
_NAMES = (b"usemtl", b"o", b"g", b"mtllib")
_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
# Options of a texture in an MTL file, and how many words follow; 0: up to three numbers
_MAP_OPTIONS = {b"-s": 0, b"-o": 0, b"-t": 0, b"-mm": 2}
_MAP_OPTIONS |= dict.fromkeys(
    b"-bm -blendu -blendv -boost -cc -clamp -colorspace -imfchan -texres -type".split(), 1
)


@dataclass
class _Material:
    """One material: its colour in [0, 1], if any, and its texture with scale and offset of the
    coordinates."""

    colour: tuple[float, ...] | None = None
    texture: bytes | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass
class _Lines:
    """The lines of an OBJ file by kind; of faces also what counted when they were read.

    Attributes:
        points, uv, faces: what follows the key.
        points_before, uv_before: vertices and texture coordinates above each face.
        material: number of the material of each face, -1 for none.
        materials: names and their numbers.
        libraries: what follows each ``mtllib``.
    """

    points: list[bytes] = field(default_factory=list)
    uv: list[bytes] = field(default_factory=list)
    faces: list[bytes] = field(default_factory=list)
    points_before: list[int] = field(default_factory=list)
    uv_before: list[int] = field(default_factory=list)
    material: list[int] = field(default_factory=list)
    materials: dict[bytes, int] = field(default_factory=dict)
    libraries: dict[bytes, None] = field(default_factory=dict)


def read_obj(source: MeshSource) -> ReadMesh:
    """Read an OBJ file with its colours: textures, colours of materials, or colours behind the
    coordinates."""
    data = plain_text(source.data())
    check_lines(data)
    lines = _lines_of(data)
    points, point_colours = _points(lines.points)
    corners, counts = _corners(lines)
    face_of, picked = _triangles(points, corners, counts)
    faces = corners[picked, 0]
    material = np.array(lines.material, np.int64)[face_of]
    colours = _colours(source, lines, material, faces, corners[picked, 1], point_colours)
    return ReadMesh(points, faces, colours)


def _lines_of(data: bytes) -> _Lines:
    if b"\\\n" in data:
        data = data.replace(b"\\\n", b" ")
    found = _Lines()
    current = -1
    parts: set[bytes] = set()
    points = found.points
    faces = found.faces
    uv = found.uv
    has_remarks = b"#" in data
    for line in data.split(b"\n"):
        start = line[:2]  # most lines, without a search for their words
        if start == b"v " and not has_remarks:
            points.append(line[2:])
            continue
        words = line.split(None, 1)
        if not words:
            continue
        key = words[0]
        rest = words[1].partition(b"#")[0] if len(words) > 1 else b""
        if key == b"v":
            points.append(rest)
        elif key == b"f":
            faces.append(rest)
            found.points_before.append(len(points))
            found.uv_before.append(len(uv))
            found.material.append(current)
        elif key == b"vt":
            uv.append(rest)
        elif key in _NAMES:
            name = words[1] if key == b"mtllib" and len(words) > 1 else rest
            current = _noted(found, parts, key, name.strip(), current)
    return found


def _noted(found: _Lines, parts: set[bytes], key: bytes, name: bytes, current: int) -> int:
    """Note the name of a material, part or library; returns the number of the material that now
    holds."""
    if key == b"usemtl":
        current = found.materials.setdefault(name, len(found.materials)) if name else -1
    elif key == b"mtllib":
        found.libraries[name] = None
    else:
        parts.add(name)
    check_parts(max(len(parts), len(found.materials), len(found.libraries)))
    return current


@dataclass
class _Table:
    """The numbers of some lines, and (N,) how many each line has, and where its first one is."""

    values: Floats
    counts: Integers

    @property
    def first(self) -> Integers:
        return np.cumsum(self.counts) - self.counts


def _table(lines: list[bytes], least: int, what: str) -> _Table:
    """The numbers of some lines, of which each has at least ``least``."""
    counts = _word_counts(lines)
    if counts.min(initial=least) < least:
        raise ValueError(f"{what} has fewer than {least} coordinates")
    return _Table(numbers(b"\n".join(lines)), counts)


def _word_counts(lines: list[bytes]) -> Integers:
    return np.fromiter((len(line.split()) for line in lines), np.int64, len(lines))


def _points(lines: list[bytes]) -> tuple[Floats, Bytes | None]:
    """(V, 3) coordinates, and (V, 3) colours if any line has some; the others are white."""
    table = _table(lines, 3, "a vertex")
    first = table.first
    points = table.values[first[:, None] + np.arange(3)]
    weighted = (table.counts == 4).nonzero()[0]
    if len(weighted):
        weight = table.values[first[weighted] + 3]
        points[weighted] /= np.where(weight == 0.0, 1.0, weight)[:, None]
    coloured = (table.counts >= 6).nonzero()[0]
    if not len(coloured):
        return points, None
    colours = np.full((len(points), 3), 255, np.uint8)
    colours[coloured] = colour_bytes(table.values[first[coloured][:, None] + np.arange(3, 6)])
    return points, colours


def _corners(lines: _Lines) -> tuple[Integers, Integers]:
    """(N, 2) vertex and texture coordinate (-1: none) of the corners of all faces, counted from 0,
    and (F,) how many corners each face has."""
    counts = _word_counts(lines.faces)
    check_faces(np.maximum(counts - 2, 0).sum())
    chunks = [_indices(lines.faces[k : k + CHUNK]) for k in range(0, len(lines.faces), CHUNK)]
    indices = np.concatenate([np.zeros((0, 2), np.int64), *chunks])
    before = np.column_stack([lines.points_before, lines.uv_before]).reshape(-1, 2)
    before = np.repeat(before, counts, axis=0)
    if (indices[:, 0] == 0).any():
        raise ValueError("a face names vertex 0; OBJ files count from 1")
    # 0, for no texture coordinate, becomes -1
    corners = np.where(indices < 0, before + indices, indices - 1)
    known = np.array([len(lines.points), len(lines.uv)])
    if (corners[:, 0] < 0).any() or (corners >= known).any() or (corners[:, 1] < -1).any():
        raise IndexError
    return corners, counts


def _indices(lines: list[bytes]) -> Integers:
    """(N, 2) indices of vertices and texture coordinates as written, 0 for none."""
    text = b" " + b"\n ".join(lines)
    text = text.replace(b"//", b"/0/")
    for fields, form in _FORMS.items():
        if form.fullmatch(text):
            values = np.fromstring(text.replace(b"/", b" ").decode(), dtype=np.int64, sep=" ")
            table = values.reshape(-1, fields)
            return table[:, :2] if fields > 1 else np.column_stack([table, np.zeros_like(table)])
    rows = [[*corner.split(b"/"), b""][:2] for corner in text.split()]
    return np.array([[int(v), int(vt or 0)] for v, vt in rows], np.int64).reshape(-1, 2)


def _triangles(points: Floats, corners: Integers, counts: Integers) -> tuple[Integers, Integers]:
    """(T,) the faces of the triangles, and (T, 3) their corners."""
    first = np.cumsum(counts) - counts
    simple = (counts == 3).nonzero()[0]
    many = (counts > 3).nonzero()[0]
    polygons = [corners[first[k] : first[k] + counts[k], 0].tolist() for k in many]
    _, owner, places = triangles_of_faces(points, polygons)
    face_of = np.concatenate([simple, many[owner]])
    places = np.concatenate([np.tile(np.arange(3), (len(simple), 1)), places])
    order = np.argsort(face_of, kind="stable")
    return face_of[order], (first[face_of][:, None] + places)[order]


def _colours(
    source: MeshSource,
    lines: _Lines,
    material: Integers,
    faces: Integers,
    uv_index: Integers,
    point_colours: Bytes | None,
) -> SurfaceColours | None:
    library = _libraries(source, list(lines.libraries))
    lost = [name for name in lines.materials if name not in library]
    if lost and lines.libraries and not source.warnings:
        names = ", ".join(spellings(name)[0] for name in lost[:3])
        text = f"its MTL files lack the material {names[:100]}; its faces are shown in white"
        source.warn("material", text)
    if point_colours is None and len(lost) == len(lines.materials):
        return None
    painting = Painting(len(faces))
    if point_colours is not None:
        painting.corners = point_colours[faces]
    table = _table(lines.uv, 1, "a texture coordinate")
    u = table.values[table.first]
    # a texture of one dimension has no v
    v = np.where(table.counts < 2, 0.0, np.append(table.values, 0.0)[table.first + 1])
    coordinates = np.nan_to_num(np.column_stack([u, v]), posinf=0.0, neginf=0.0)
    has_uv = (uv_index >= 0).all(axis=1)
    order = np.argsort(material, kind="stable")
    starts = np.searchsorted(material[order], np.arange(len(lines.materials) + 1))
    for name, number in lines.materials.items():
        found = library.get(name)
        own = order[starts[number] : starts[number + 1]]
        if found is None or not len(own):
            continue
        if point_colours is None and found.colour is not None:
            painting.corners[own] = byte_colours(found.colour)
        texture = None if found.texture is None else source.texture_file(*spellings(found.texture))
        if texture is not None:
            own = own[np.take(has_uv, own)]
            painting.corners[own] = 255  # beside a texture, exporters write any colour
            uv = coordinates[uv_index[own]] * found.scale + found.offset
            painting.add_texture(own, texture, uv)
    return painting.finished()


def _libraries(source: MeshSource, statements: list[bytes]) -> dict[bytes, _Material]:
    """The materials of all libraries, by name; of two of one name the first counts."""
    materials: dict[bytes, _Material] = {}
    contents: dict[bytes, bytes | None] = {}
    for statement in statements:
        whole = next((name for name in spellings(statement) if source.has(name)), None)
        for name in [statement] if whole else statement.split():
            if name not in contents:
                contents[name] = source.read_optional("material", *spellings(name))
    for content in contents.values():
        if content is not None:
            for name, material in _materials(plain_text(content)).items():
                materials.setdefault(name, material)
    return materials


def _materials(data: bytes) -> dict[bytes, _Material]:
    found: dict[bytes, _Material] = {}
    current = _Material()
    for line in data.split(b"\n"):
        words = line.split(None, 1)
        if not words or words[0].startswith(b"#"):
            continue
        key = words[0].lower()
        rest = words[1].strip() if len(words) > 1 else b""
        if key == b"newmtl":
            current = found.setdefault(rest, _Material())
        elif key == b"kd":
            current.colour = _colour(rest)
        elif key == b"map_kd":
            _set_texture(current, rest)
    return found


def _colour(text: bytes) -> tuple[float, ...] | None:
    """One grey value or three colours; None for spectral curves and CIEXYZ."""
    words = text.split()[:3]
    if not words or not all(_NUMBER.fullmatch(word) for word in words):
        return None
    values = [float(word) for word in words]
    return tuple(values) if len(values) == 3 else (values[0],) * 3


def _set_texture(material: _Material, text: bytes) -> None:
    """The file name behind the options of a ``map_Kd``, and the options that move the texture."""
    while text.startswith(b"-"):
        word, rest = [*text.split(None, 1), b""][:2]
        option = word.lower()
        if option not in _MAP_OPTIONS:
            break
        numeric = [*map(float, takewhile(_NUMBER.fullmatch, rest.split(None, 3)[:3]))]
        count = _MAP_OPTIONS[option] or len(numeric)
        if option == b"-s" and numeric:
            material.scale = numeric[0], [*numeric, 1.0][1]
        elif option == b"-o" and numeric:
            material.offset = numeric[0], [*numeric, 0.0][1]
        pieces = rest.split(None, count)
        text = pieces[count] if len(pieces) > count else b""
    material.texture = text.strip().strip(b'"') or None
