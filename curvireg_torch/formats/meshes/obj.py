"""OBJ files and their material libraries, in time proportional to their size.

trimesh 5.2 counts negative indices from the end of the file, loses the first vertex behind a
byte-order mark, and refuses Latin-1. Once it reads negative.obj, bom.obj and concave.obj of
scripts/upstream, several libraries, and options of textures, this reader can go.
"""

import re
from array import array
from dataclasses import dataclass, field
from itertools import takewhile

import numpy as np

from ...utils.arrays import Bytes, Floats, Integers
from .colours import SurfaceColours, byte_colours
from .limits import check_corners, check_lines, check_parts
from .polygons import triangulated
from .source import MeshSource, ReadMesh, colour_bytes, numbers, plain_text, spellings

CHUNK = 100_000  # Lines of faces that are read at once, which bounds the memory
_NAMES = (b"usemtl", b"o", b"g", b"mtllib")
_REMARK = re.compile(rb"(?:^|\s)#(?:\s.*)?$")  # "Material #27" of 3ds Max has none
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

    colour: list[float] | None = None
    texture: bytes | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass
class _Lines:
    """The lines of an OBJ file by kind; of faces also what counted when they were read.

    Attributes:
        points, uv, faces: what follows the key.
        above: of each face the numbers of points and of texture coordinates above it, and that of
            its material, -1 for none.
        materials: names and their numbers.
        libraries: what follows each ``mtllib``.
        parts: names of objects and groups.
        material: the number of the last ``usemtl``.
    """

    points: list[bytes] = field(default_factory=list)
    uv: list[bytes] = field(default_factory=list)
    faces: list[bytes] = field(default_factory=list)
    above: "array[int]" = field(default_factory=lambda: array("q"))
    materials: dict[bytes, int] = field(default_factory=dict)
    libraries: dict[bytes, None] = field(default_factory=dict)
    parts: set[bytes] = field(default_factory=set)
    material: int = -1

    def note(self, key: bytes, name: bytes) -> None:
        """Note the name of a material, part or library."""
        if key == b"usemtl":
            number = len(self.materials)
            self.material = self.materials.setdefault(name, number) if name else -1
        elif key == b"mtllib":
            self.libraries[name] = None
        else:
            self.parts.add(name)
        check_parts(max(len(self.parts), len(self.materials), len(self.libraries)))


def read_obj(source: MeshSource) -> ReadMesh:
    """Read an OBJ file with its colours: textures, colours of materials, or colours behind the
    coordinates."""
    data = plain_text(source.data())
    check_lines(data)
    lines = _lines_of(data)
    points, point_colours = _points(lines.points)
    above = np.array(lines.above, np.int64).reshape(-1, 3)
    corners, counts = _corners(lines, above[:, :2])
    picked, face_of = triangulated(points, corners[:, 0], counts)
    faces, uv_index = np.moveaxis(corners[picked], -1, 0)
    colours = _colours(source, lines, above[face_of, 2], faces, uv_index, point_colours)
    return ReadMesh(points, faces, colours)


def _lines_of(data: bytes) -> _Lines:
    if b"\\\n" in data:
        data = data.replace(b"\\\n", b" ")
    found = _Lines()
    points = found.points
    has_remarks = b"#" in data
    for line in data.split(b"\n"):
        if line[:2] == b"v " and not has_remarks:  # most lines, without a search for their words
            points.append(line[2:])
            continue
        key, whole = [*line.split(None, 1), b"", b""][:2]
        rest = whole.partition(b"#")[0]
        if key == b"v":
            points.append(rest)
        elif key == b"f":
            found.faces.append(rest)
            found.above.extend((len(points), len(found.uv), found.material))
        elif key == b"vt":
            found.uv.append(rest)
        elif key in _NAMES:
            found.note(key, _REMARK.sub(b"", whole).strip())
    return found


def _table(lines: list[bytes], least: int, most: int, what: str) -> tuple[Floats, Integers]:
    """(N, most) the first numbers of some lines, 0 for those that a line lacks, and (N,) how many
    it has, which must be at least ``least``."""
    counts = _word_counts(lines)
    if counts.min(initial=least) < least:
        raise ValueError(f"{what} has fewer than {least} coordinates")
    values = np.append(numbers(b"\n".join(lines)), np.zeros(most))
    columns = np.arange(most)
    table = values[(np.cumsum(counts) - counts)[:, None] + columns]
    table[columns >= counts[:, None]] = 0.0
    return table, counts


def _word_counts(lines: list[bytes]) -> Integers:
    return np.fromiter((len(line.split()) for line in lines), np.int64, len(lines))


def _points(lines: list[bytes]) -> tuple[Floats, Bytes | None]:
    """(V, 3) coordinates, and (V, 3) colours if any line has some; the others are white."""
    table, counts = _table(lines, 3, 6, "a vertex")
    points = table[:, :3].copy()
    weighted = (counts == 4) & (table[:, 3] != 0.0)
    points[weighted] /= table[weighted, 3:4]
    coloured = counts >= 6
    if not coloured.any():
        return points, None
    colours = np.full((len(points), 3), 255, np.uint8)
    colours[coloured] = colour_bytes(table[coloured, 3:])
    return points, colours


def _corners(lines: _Lines, above: Integers) -> tuple[Integers, Integers]:
    """(N, 2) vertex and texture coordinate (-1: none) of the corners of all faces, counted from 0,
    and (F,) how many corners each face has."""
    counts = _word_counts(lines.faces)
    chunks = [_indices(lines.faces[k : k + CHUNK]) for k in range(0, len(lines.faces), CHUNK)]
    indices = np.concatenate([np.zeros((0, 2), np.int64), *chunks])
    if (indices[:, 0] == 0).any():
        raise ValueError("a face names vertex 0; OBJ files count from 1")
    # 0, for no texture coordinate, becomes -1
    corners = np.where(indices < 0, np.repeat(above, counts, axis=0) + indices, indices - 1)
    check_corners(corners[:, 1] + 1, len(lines.uv) + 1)
    return corners, counts


def _indices(lines: list[bytes]) -> Integers:
    """(N, 2) indices of vertices and texture coordinates as written, 0 for none."""
    corners = b" ".join(lines).replace(b"//", b"/0/").split()
    fields = 1 + max((corner.count(b"/") for corner in corners), default=0)
    words = b" ".join(corners).replace(b"/", b" ").split()
    if len(words) < fields * len(corners):  # some corners have fewer fields than others
        pairs = [[*corner.split(b"/"), b""][:2] for corner in corners]
        words = [word or b"0" for pair in pairs for word in pair]
        fields = 2
    table = np.array(words, np.int64).reshape(-1, fields)
    return np.pad(table, ((0, 0), (0, 1)))[:, :2]


def _colours(
    source: MeshSource,
    lines: _Lines,
    material: Integers,
    faces: Integers,
    uv_index: Integers,
    point_colours: Bytes | None,
) -> SurfaceColours | None:
    library = _libraries(source, list(lines.libraries))
    # a remark without a blank may follow a name
    names = [
        name if name in library else name.partition(b" #")[0].strip() for name in lines.materials
    ]
    lost = [name for name in names if name not in library]
    if lost and lines.libraries and not source.warnings:
        some = ", ".join(spellings(name)[0] for name in lost[:3])
        text = f"its MTL files lack the material {some[:100]}; its faces are shown in white"
        source.warn("material", text)
    if point_colours is None and len(lost) == len(names):
        return None
    painted = SurfaceColours.plain(len(faces))
    if point_colours is not None:
        painted.corners[:] = point_colours[faces]
    # a texture of one dimension has no v
    coordinates, _ = _table(lines.uv, 1, 2, "a texture coordinate")
    has_uv = (uv_index >= 0).all(axis=1)
    order = np.argsort(material, kind="stable")
    starts = np.searchsorted(material[order], np.arange(len(lines.materials)))
    for name, own in zip(names, np.split(order, starts)[1:], strict=True):
        found = library.get(name)
        if found is None or not len(own):
            continue
        if point_colours is None and found.colour is not None:
            painted.corners[own] = byte_colours(found.colour)
        texture = None if found.texture is None else source.texture_file(*spellings(found.texture))
        if texture is not None:
            has_own = np.take(has_uv, own)
            if not has_own.all():
                lack = "faces of a textured material lack texture coordinates; they are shown "
                source.warn("texture", f"{lack}in its plain colour")
            own = own[has_own]
            painted.corners[own] = 255  # beside a texture, exporters write any colour
            uv = np.nan_to_num(coordinates[uv_index[own]], posinf=0.0, neginf=0.0)
            painted = painted.with_texture(own, texture, uv * found.scale + found.offset)
    return painted


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
        word, rest = [*_REMARK.sub(b"", line).split(None, 1), b"", b""][:2]
        key = word.lower()
        if key == b"newmtl":
            current = found.setdefault(rest.strip(), _Material())
        elif key == b"kd":
            # one grey value or three colours; none of spectral curves and CIEXYZ
            values = _leading_numbers(rest)
            current.colour = values if len(values) == 3 else values[:1] * 3 or None
        elif key == b"map_kd":
            _set_texture(current, rest.strip())
    return found


def _leading_numbers(text: bytes) -> list[float]:
    """Up to three numbers that a text begins with."""
    return [*map(float, takewhile(_NUMBER.fullmatch, text.split(None, 3)[:3]))]


def _set_texture(material: _Material, text: bytes) -> None:
    """The file name behind the options of a ``map_Kd``, and the options that move the texture."""
    while text.startswith(b"-"):
        word, rest = [*text.split(None, 1), b""][:2]
        option = word.lower()
        if option not in _MAP_OPTIONS:
            break
        values = _leading_numbers(rest)
        count = _MAP_OPTIONS[option] or len(values)
        if option == b"-s" and values:
            material.scale = values[0], [*values, 1.0][1]
        elif option == b"-o" and values:
            material.offset = values[0], [*values, 0.0][1]
        text = b"".join(rest.split(None, count)[count:])
    material.texture = text.strip().strip(b'"') or None
