"""PLY files, as trimesh parses them; which of their properties are coordinates, faces and colours
is decided here.

Once trimesh reads colours under their other names and of 16 bits, coordinates of corners and
several textures, and says that a file ends too early, the half of this reader behind its parser can
go.
"""

import re
from collections.abc import Sequence
from io import BytesIO
from typing import NamedTuple

import numpy as np
import trimesh

from ...utils.aliases import Fields
from ...utils.arrays import Bytes, Floats, Integers
from .colours import SurfaceColours
from .limits import check_lines
from .polygons import triangulated
from .source import MeshSource, ReadMesh, colour_bytes, spellings

MAX_COLUMNS = 500  # Properties in a header, whose number squared bounds the time
_COLOURS = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
_COORDINATES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"), ("s_tex", "t_tex"))
_FACE_LISTS = ("vertex_indices", "vertex_index")
_TEXTURE_FILE = re.compile(
    rb"^comment[ \t]+TextureFile[ \t]+([^\r\n]+)", re.MULTILINE | re.IGNORECASE
)
# A name by which trimesh would look for the texture coordinates of triangles, and one that it does
# not know
_CORNERS = re.compile(rb"^(property[ \t]+list[ \t]+\w+[ \t]+\w+[ \t]+)texcoord\b", re.MULTILINE)
_OWN_CORNERS = "corner_uv"
# Number of a kind of rows, and its properties; of each property whether it is a list
_ROWS = re.compile(rb"^element[ \t]+\w+[ \t]+(\d+)[^\n]*\n((?:property[^\n]*\n)*)", re.MULTILINE)
_PROPERTIES = re.compile(rb"^property[ \t]+(list[ \t])?", re.MULTILINE)
_REMARK = re.compile(rb"^(?:comment|obj_info)[^\n]*\n", re.MULTILINE)


def read_ply(source: MeshSource) -> ReadMesh:
    """Read a PLY file with the colours of its vertices or faces, or its textures."""
    data = source.data().removeprefix(b"\xef\xbb\xbf")
    header, end, body = data.partition(b"end_header")
    if not end or not header.startswith(b"ply"):
        raise ValueError("not a PLY file, or its header ends too early")
    if max(header.count(b"property"), header.count(b"element")) > MAX_COLUMNS:
        raise ValueError(f"more than {MAX_COLUMNS:,} kinds of rows or columns")
    names = [name.strip() for name in _TEXTURE_FILE.findall(header)]
    plain = _REMARK.sub(b"", header.replace(b"\r\n", b"\n"))
    if b"ascii" in header[:100]:
        check_lines(body)
        _check_last_line(plain, body)
    else:
        body = body.removeprefix(b"\r")
    plain = plain.decode("ascii", errors="replace").encode()
    plain = _CORNERS.sub(rb"\1" + _OWN_CORNERS.encode(), plain)
    raw = trimesh.exchange.ply.load_ply(
        BytesIO(plain + end + body), skip_materials=True, fix_texture=False
    )
    kinds = {name: _Rows(name, rows) for name, rows in raw["metadata"]["_ply_raw"].items()}
    points = kinds.get("vertex", _Rows())
    polygons = kinds.get("face", _Rows())
    if not points.columns:
        return ReadMesh.joined([])
    vertices = points.table(("x", "y", "z"))
    if vertices is None:
        raise ValueError("its vertices have no x, y and z")
    if not polygons.columns and "tristrips" in kinds:
        raise ValueError("its faces are strips of triangles, which are not read; export triangles")
    if not polygons.columns:
        return ReadMesh(vertices, np.zeros((0, 3), np.int64))
    name = next(filter(polygons.columns.__contains__, [*_FACE_LISTS, *polygons.columns]))
    values, counts = polygons.lists(name)
    corners = values.astype(np.int64)
    picked, owner = triangulated(vertices, corners, counts)
    faces = _Faces(corners[picked], owner, picked, counts)
    return ReadMesh(vertices, faces.vertices, _colours(source, points, polygons, names, faces))


def _check_last_line(header: bytes, body: bytes) -> None:
    """Refuse a last line that has fewer values than the last rows have: trimesh takes a list that
    ends early for a shorter one."""
    kinds = [properties for count, properties in _ROWS.findall(header) if int(count)]
    values = body.rstrip().rpartition(b"\n")[2].split()
    needed = 0
    for length in _PROPERTIES.findall(kinds[-1] if kinds else b""):
        is_list = length and needed < len(values) and values[needed].isdigit()
        needed += 1 + (int(values[needed]) if is_list else 0)
    if needed > len(values):
        raise ValueError("the file ends within its last row")


class _Faces(NamedTuple):
    """(T, 3) vertices of triangles, (T,) the polygons that they are of, (T, 3) which corners of all
    polygons they have; and (P,) how many corners each polygon has."""

    vertices: Integers
    owner: Integers
    corners: Integers
    counts: Integers


class _Rows:
    """One kind of rows of the file, as trimesh has parsed it: its columns by name."""

    def __init__(self, name: str = "", parsed: Fields | None = None) -> None:
        parsed = parsed or {"length": 0}
        data = parsed.get("data")
        self.columns: Fields = data if isinstance(data, dict) else {}
        if isinstance(data, np.ndarray):
            self.columns = {key: data[key] for key in data.dtype.names}
        if min(map(len, self.columns.values()), default=0) < parsed["length"]:
            raise ValueError(f"the file ends before the last {name}")

    def table(self, names: Sequence[str]) -> Floats | None:
        """(N, K) values of some columns, None if one is absent."""
        if not set(names) <= self.columns.keys():
            return None
        columns = [np.asarray(self.columns[name], np.float64).reshape(-1) for name in names]
        return np.column_stack(columns)

    def colours(self) -> Bytes | None:
        """(N, 3) colours under one of the names that exporters use; floating ones are in [0, 1],
        and those of 16 bits are scaled if they need more than 8."""
        for names in _COLOURS:
            values = self.table(names)
            if values is None:
                continue
            stored = np.asarray(self.columns[names[0]]).dtype
            if stored.kind == "f":
                return colour_bytes(values)
            is_large = (stored.kind, stored.itemsize) == ("u", 2) and values.max(initial=0.0) > 255
            factor = 255.0 / 65535.0 if is_large else 1.0
            return np.clip(np.nan_to_num(factor * values).round(), 0, 255).astype(np.uint8)
        return None

    def lists(self, name: str) -> tuple[Floats, Integers]:
        """The values of a column of lists, one list after the other, and (N,) their lengths."""
        rows = self.columns[name]
        if rows.dtype.names is not None:
            # trimesh takes the first face's number of corners for that of all
            if (rows["f0"] != rows["f1"].shape[1]).any():
                raise ValueError(
                    "binary faces with different numbers of corners are not read; export triangles"
                )
            rows = rows["f1"]
        if rows.ndim == 2:
            return rows.reshape(-1), np.full(len(rows), rows.shape[1])
        return np.concatenate([np.zeros(0), *rows]), np.array([*map(len, rows)], np.int64)


def _colours(
    source: MeshSource, points: _Rows, polygons: _Rows, names: list[bytes], faces: _Faces
) -> SurfaceColours | None:
    """Textures first, then colours of faces, then of vertices."""
    painted = SurfaceColours.plain(len(faces.vertices))
    uv = _coordinates(points, polygons, faces) if names else None
    if uv is not None:
        number = polygons.table(["texnumber"])
        if number is None and len(names) > 1:
            source.warn(
                "texture",
                f"it names {len(names)} textures and does not say which face has which; the first "
                "is used",
            )
        texture = np.zeros(len(uv)) if number is None else number[faces.owner, 0]
        pixels = [source.texture_file(*spellings(name)) for name in names]
        for index, picture in enumerate(pixels):
            own = texture == index
            if picture is not None:
                painted = painted.with_texture(own, picture, uv[own])
        if painted.textures:
            return painted
    elif names:
        source.warn(
            "texture",
            "it names a texture and has no texture coordinates; the mesh is shown without it",
        )
    of_faces = polygons.colours()
    of_points = points.colours()
    if of_faces is not None:
        painted.corners[:] = of_faces[faces.owner][:, None]
    elif of_points is not None:
        painted.corners[:] = of_points[faces.vertices]
    else:
        return None
    return painted


def _coordinates(points: _Rows, polygons: _Rows, faces: _Faces) -> Floats | None:
    """(T, 3, 2) texture coordinates, of the faces' corners or of the vertices."""
    if _OWN_CORNERS not in polygons.columns:
        tables = [points.table(names) for names in _COORDINATES]
        return next((table[faces.vertices] for table in tables if table is not None), None)
    values, counts = polygons.lists(_OWN_CORNERS)
    if (counts != 2 * faces.counts).any():
        raise ValueError("texture coordinates that do not fit the faces")
    return values.reshape(-1, 2)[faces.corners]
