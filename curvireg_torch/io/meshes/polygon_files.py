"""OBJ, OFF and PLY files with faces of more than three corners, rewritten with triangles.

Readers, trimesh's too, fill such faces by fans, which is wrong where a face is concave. All else in the file stays as
it is: texture coordinates, colours, materials.
"""

import re
import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...limits import MAX_MESH_FACES, MAX_MESH_LINES, MAX_POLYGON_WORK
from .polygons import Floats, ear_work, triangulate

__all__ = ["with_triangles"]


def with_triangles(data: bytes, suffix: str) -> bytes:
    """The content of a file of format ``suffix`` with every face a triangle; the same bytes if all are.

    Raises:
        ValueError: the file is damaged, or beyond :mod:`curvireg_torch.limits`.
    """
    try:
        return {".obj": _obj, ".off": _off, ".ply": _ply}[suffix](data)
    except (struct.error, IndexError) as error:
        raise ValueError("the file ends too early") from error


def _divided(vertices: Floats, faces: list[list[int]]) -> Iterator[tuple[int, list[list[int]]]]:
    """For each face its place in ``faces`` and its triangles as numbers of corners; lines and points have none."""
    _check_faces(sum(max(len(face) - 2, 0) for face in faces))
    places, work = defaultdict(list), 0
    for place, face in enumerate(faces):
        places[len(face)].append(place)
        if face and not 0 <= min(face) <= max(face) < len(vertices):
            raise ValueError(f"face {place} names vertices that do not exist")
    for corners, some in places.items():
        if corners >= 3:
            polygons = vertices[np.array([faces[place] for place in some])]
            work += ear_work(polygons)
            if work > MAX_POLYGON_WORK:
                raise ValueError("faces that are not convex have too many corners; triangulate the mesh")
            yield from zip(some, triangulate(polygons).tolist(), strict=True)


def _check_faces(count: int) -> None:
    if count > MAX_MESH_FACES:
        raise ValueError(f"more than {MAX_MESH_FACES:,} faces; simplify it")


def _check_lines(data: bytes) -> None:
    if max(data.count(b"\n"), data.count(b"\r")) > MAX_MESH_LINES:
        raise ValueError(f"more than {MAX_MESH_LINES:,} lines; simplify it")


_OBJ_OTHER = re.compile(rb"^f[ \t]+(?:(?:[^ \t\r\n]+[ \t]+){3}[^ \t\r\n#]|[^\r\n]*-)", re.MULTILINE)


def _obj(data: bytes) -> bytes:
    data = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    if _OBJ_OTHER.search(data) is None:
        return data
    _check_lines(data)
    lines = data.splitlines()
    vertices: list[list[bytes]] = []
    counts, places, faces = {b"v": 0, b"vt": 0, b"vn": 0}, [], []
    for place, line in enumerate(lines):
        words = line.split(b"#")[0].split()
        key = words[0] if words else b""
        if key == b"v":
            vertices.append(words[1:4])
        if key in counts:
            counts[key] += 1
        elif key == b"f":
            places.append((place, [_from_the_start(word, counts) for word in words[1:]]))
            faces.append([int(word.split(b"/")[0]) - 1 for word in places[-1][1]])
    for place, _ in places:
        lines[place] = b""
    for face, triangles in _divided(np.array(vertices, dtype=np.float64).reshape(-1, 3), faces):
        place, words = places[face]
        lines[place] = b"\n".join(b"f " + b" ".join(words[i] for i in triangle) for triangle in triangles)
    return b"\n".join(lines) + b"\n"


def _from_the_start(corner: bytes, counts: dict[bytes, int]) -> bytes:
    """``v/vt/vn`` with the numbers below 0, which count back from what came before, counted from 1."""
    if b"-" not in corner:
        return corner
    numbers = zip(corner.split(b"/"), counts.values(), strict=False)
    return b"/".join(b"%d" % (count + 1 + int(n)) if n.startswith(b"-") else n for n, count in numbers)


def _off(data: bytes) -> bytes:
    header, _, rest = re.sub(rb"#[^\r\n]*", b"", data).partition(b"OFF")
    _check_lines(rest)
    lines = [line for line in rest.splitlines() if line.strip()]
    if len(header) > 16 or not lines:
        raise ValueError("not an OFF file")
    V, F = (int(n) for n in lines[0].split()[:2])
    if V < 0 or F < 0 or len(lines) < 1 + V + F:
        raise ValueError("the file ends too early")
    _check_faces(F)
    words = [line.split() for line in lines[1 + V : 1 + V + F]]
    if all(line[0] == b"3" for line in words):
        return data
    faces = [[int(n) for n in line[1 : 1 + int(line[0])]] for line in words]
    vertices = np.array([line.split()[:3] for line in lines[1 : 1 + V]], dtype=np.float64).reshape(-1, 3)
    rows = []
    for place, triangles in _divided(vertices, faces):
        colour = words[place][1 + len(faces[place]) :]
        rows += [b" ".join([b"3", *(words[place][1 + i] for i in triangle), *colour]) for triangle in triangles]
    return b"\n".join([b"OFF", b"%d %d 0" % (V, len(rows)), *lines[1 : 1 + V], *rows, b""])


_PLY_TYPES = {
    **dict.fromkeys(["char", "int8"], "b"),
    **dict.fromkeys(["uchar", "uint8"], "B"),
    **dict.fromkeys(["short", "int16"], "h"),
    **dict.fromkeys(["ushort", "uint16"], "H"),
    **dict.fromkeys(["int", "int32"], "i"),
    **dict.fromkeys(["uint", "uint32"], "I"),
    **dict.fromkeys(["float", "float32"], "f"),
    **dict.fromkeys(["double", "float64"], "d"),
}


@dataclass
class _Element:
    """``properties``: name, type of the count (None: one value, no list), type of the values."""

    name: str
    count: int
    properties: list[tuple[str, str | None, str]]

    @property
    def lists(self) -> bool:
        return any(count is not None for _, count, _ in self.properties)


@dataclass
class _Layout:
    """Where the elements ``before`` the faces begin, and the faces' property that lists corners."""

    order: str
    start: int
    before: list[_Element]
    face: _Element
    index: int


def _ply(data: bytes) -> bytes:
    end = re.search(rb"end_header[ \t]*(?:\r\n|\r|\n)", data)
    if end is None or not data.startswith(b"ply"):
        raise ValueError("not a PLY file")
    header = data[: end.end()].decode("latin-1")
    order, elements = _ply_header(header)
    names = [element.name for element in elements]
    if "face" not in names or "vertex" not in names[: names.index("face")]:
        return data
    before, face = elements[: names.index("face")], elements[names.index("face")]
    named = [name for name, count, _ in face.properties if count is not None]
    key = next((name for name in named if name in ("vertex_indices", "vertex_index")), *named[:1])
    if any(element.lists for element in before) or key is None:
        raise ValueError("only faces may hold lists, and they must")
    index = [name for name, _, _ in face.properties].index(key)
    _check_faces(face.count)
    read = _ply_text if order == "" else _ply_binary
    vertices, rows, start, stop, write = read(data, _Layout(order, end.end(), before, face, index))
    faces = [[int(n) for n in row[index]] for row in rows]
    if all(len(corners) == 3 for corners in faces):
        return data
    body = []
    for place, triangles in _divided(vertices, faces):
        n = len(faces[place])
        for triangle in triangles:
            body.append(write([_of_corners(value, triangle, n) for value in rows[place]]))
    header = re.sub(r"(element[ \t]+face[ \t]+)\d+", rf"\g<1>{len(body)}", header)
    return header.encode("latin-1") + data[end.end() : start] + b"".join(body) + data[stop:]


def _of_corners(value: Any, triangle: list[int], n: int) -> Any:
    """A property of a face of ``n`` corners for a triangle of it: lists that hold something for each corner shrink."""
    if not isinstance(value, list | tuple) or not value or len(value) % n:
        return value
    each = len(value) // n
    return [value[each * i + k] for i in triangle for k in range(each)]


def _ply_header(header: str) -> tuple[str, list[_Element]]:
    """Byte order ("" for text) and elements."""
    order, elements = None, []
    for line in header.splitlines():
        match line.split():
            case ["format", kind, _]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}.get(kind)
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count, kind, name] if elements:
                elements[-1].properties.append((name, _PLY_TYPES.get(count, "?"), _PLY_TYPES.get(kind, "?")))
            case ["property", kind, name] if elements:
                elements[-1].properties.append((name, None, _PLY_TYPES.get(kind, "?")))
    if order is None or any("?" in (count, kind) for e in elements for _, count, kind in e.properties):
        raise ValueError("a PLY file of an unknown format or type")
    if any(element.count < 0 for element in elements):
        raise ValueError("an element of negative number")
    return order, elements


def _ply_text(data: bytes, layout: _Layout) -> tuple[Any, ...]:
    """Vertices, values of the faces, first and last byte of them, and what writes one."""
    face, start = layout.face, layout.start
    _check_lines(data)
    lines = data[start:].splitlines(keepends=True)
    skipped = 0
    for element in layout.before:
        if element.name == "vertex":
            names = [name for name, _, _ in element.properties]
            columns = [names.index(axis) for axis in "xyz"]
            rows = [line.split() for line in lines[skipped : skipped + element.count]]
            vertices = np.array([[row[i] for i in columns] for row in rows], dtype=np.float64).reshape(-1, 3)
        skipped += element.count
    begin = start + sum(map(len, lines[:skipped]))
    own = lines[skipped : skipped + face.count]
    if len(own) < face.count:
        raise ValueError("the file ends too early")
    if layout.index == 0 and all(line.lstrip().startswith(b"3 ") for line in own):
        own = []  # triangles only
    rows_of_values = []
    for line in own:
        row: list[Any] = []
        words, position = line.split(), 0
        for _, count, _ in face.properties:
            if count is None:
                row.append(words[position])
                position += 1
            else:
                length = int(words[position])
                row.append(words[position + 1 : position + 1 + length])
                position += 1 + length
                if position > len(words):
                    raise ValueError("the file ends too early")
        rows_of_values.append(row)

    def write(row: list[Any]) -> bytes:
        words = [b" ".join([b"%d" % len(v), *v]) if isinstance(v, list) else v for v in row]
        return b" ".join(words) + b"\n"

    return vertices, rows_of_values, begin, begin + sum(map(len, own)), write


def _ply_binary(data: bytes, layout: _Layout) -> tuple[Any, ...]:
    """As :func:`_ply_text`."""
    face, start, order = layout.face, layout.start, layout.order
    for element in layout.before:
        row_type = np.dtype([(name, order + kind) for name, _, kind in element.properties])
        if start + element.count * row_type.itemsize > len(data):
            raise ValueError("the file ends too early")
        if element.name == "vertex":
            block = np.frombuffer(data, row_type, element.count, start)
            vertices = np.stack([block[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        start += element.count * row_type.itemsize
    position, rows = start, []
    for _ in range(0 if _triangles_only(data, start, layout) else face.count):
        row: list[Any] = []
        for _, count, kind in face.properties:
            length = 1
            if count is not None:
                (length,) = struct.unpack_from(order + count, data, position)
                position += struct.calcsize(count)
            values = struct.unpack_from(f"{order}{int(length)}{kind}", data, position)
            position += struct.calcsize(kind) * int(length)
            row.append(values[0] if count is None else values)
        rows.append(row)

    def write(row: list[Any]) -> bytes:
        parts = []
        for (_, count, kind), value in zip(face.properties, row, strict=True):
            if count is None:
                parts.append(struct.pack(order + kind, value))
            else:
                parts.append(struct.pack(f"{order}{count}", len(value)))
                parts.append(struct.pack(f"{order}{len(value)}{kind}", *value))
        return b"".join(parts)

    return vertices, rows, start, position, write


def _triangles_only(data: bytes, start: int, layout: _Layout) -> bool:
    """Whether all faces have three corners; a quick answer, which may be no where yes is true."""
    face, order = layout.face, layout.order
    if sum(count is not None for _, count, _ in face.properties) > 1:
        return False
    fields: list[Any] = []
    for place, (_, count, kind) in enumerate(face.properties):
        if place == layout.index:
            fields += [("corners", f"{order}{count}"), ("indices", order + kind, (3,))]
        else:
            fields.append((f"other{place}", order + kind))
    row_type = np.dtype(fields)
    if start + face.count * row_type.itemsize > len(data):
        return False
    return bool((np.frombuffer(data, row_type, face.count, start)["corners"] == 3).all())
