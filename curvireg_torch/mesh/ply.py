"""PLY files, text and binary, rewritten with triangles in place of polygons.

Other elements and properties stay; a list property with values for each corner is reduced to those of the triangle.
"""

import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from .polygons import Floats, check_face_count, check_line_count, divide_faces

_TYPES = {
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
    """``properties``: name, type of the length (None for a single value), type of the values."""

    name: str
    count: int
    properties: list[tuple[str, str | None, str]]

    @property
    def has_lists(self) -> bool:
        return any(length is not None for _, length, _ in self.properties)


@dataclass
class _Layout:
    """Byte order ("" for text), end of the header, elements before the faces, and the property that lists corners."""

    order: str
    start: int
    before: list[_Element]
    face: _Element
    corners: int


_Body = tuple[Floats, list[list[Any]], int, int]
"""Vertices, the values of each face (none if all are triangles), and start and stop of the bytes of the faces."""


def with_triangles(data: bytes) -> bytes:
    """The content of a PLY file with every face a triangle; the same bytes if all are."""
    end = re.search(rb"end_header[ \t]*(?:\r\n|\r|\n)", data)
    if end is None or not data.startswith(b"ply"):
        raise ValueError("not a PLY file")
    header = data[: end.end()].decode("latin-1")
    order, elements = _parse_header(header)
    names = [element.name for element in elements]
    if "face" not in names or "vertex" not in names[: names.index("face")]:
        return data
    before, face = elements[: names.index("face")], elements[names.index("face")]
    lists = [name for name, length, _ in face.properties if length is not None]
    key = next((name for name in lists if name in ("vertex_indices", "vertex_index")), *lists[:1])
    if any(element.has_lists for element in before) or key is None:
        raise ValueError("only faces may hold lists, and they must")
    corners = [name for name, _, _ in face.properties].index(key)
    check_face_count(face.count)
    layout = _Layout(order, end.end(), before, face, corners)
    vertices, rows, start, stop = _read_binary(data, layout) if order else _read_text(data, layout)
    faces = [[int(n) for n in row[corners]] for row in rows]
    if all(len(face) == 3 for face in faces):
        return data
    written = []
    for index, triangles in divide_faces(vertices, faces):
        for triangle in triangles:
            values = [_of_triangle(value, triangle, len(faces[index])) for value in rows[index]]
            written.append(_pack(values, layout) if order else _format(values))
    header = re.sub(r"(element[ \t]+face[ \t]+)\d+", rf"\g<1>{len(written)}", header)
    return header.encode("latin-1") + data[end.end() : start] + b"".join(written) + data[stop:]


def _parse_header(header: str) -> tuple[str, list[_Element]]:
    """Byte order ("" for text) and elements."""
    order, elements = None, []
    for line in header.splitlines():
        match line.split():
            case ["format", form, _]:
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if elements:
                elements[-1].properties.append((name, _TYPES.get(length, "?"), _TYPES.get(kind, "?")))
            case ["property", kind, name] if elements:
                elements[-1].properties.append((name, None, _TYPES.get(kind, "?")))
    if order is None or any("?" in (length, kind) for e in elements for _, length, kind in e.properties):
        raise ValueError("a PLY file of an unknown format or type")
    if any(element.count < 0 for element in elements):
        raise ValueError("an element of negative number")
    return order, elements


def _of_triangle(value: Any, triangle: list[int], n: int) -> Any:
    """A property of a face of ``n`` corners for a triangle of it; lists with values for each corner are reduced."""
    if not isinstance(value, list | tuple) or not value or len(value) % n:
        return value
    each = len(value) // n
    return [value[each * i + k] for i in triangle for k in range(each)]


def _read_text(data: bytes, layout: _Layout) -> _Body:
    face = layout.face
    check_line_count(data)
    lines = data[layout.start :].splitlines(keepends=True)
    first = 0
    for element in layout.before:
        if element.name == "vertex":
            names = [name for name, _, _ in element.properties]
            columns = [names.index(axis) for axis in "xyz"]
            words_of = [line.split() for line in lines[first : first + element.count]]
            vertices = np.array([[words[i] for i in columns] for words in words_of], dtype=np.float64).reshape(-1, 3)
        first += element.count
    start = layout.start + sum(map(len, lines[:first]))
    lines = lines[first : first + face.count]
    if len(lines) < face.count:
        raise ValueError("the file ends too early")
    stop = start + sum(map(len, lines))
    if layout.corners == 0 and all(line.lstrip().startswith(b"3 ") for line in lines):
        return vertices, [], start, stop
    rows = []
    for line in lines:
        row: list[Any] = []
        words, position = line.split(), 0
        for _, length_type, _ in face.properties:
            if length_type is None:
                row.append(words[position])
                position += 1
            else:
                length = int(words[position])
                row.append(words[position + 1 : position + 1 + length])
                position += 1 + length
                if position > len(words):
                    raise ValueError("the file ends too early")
        rows.append(row)
    return vertices, rows, start, stop


def _format(values: list[Any]) -> bytes:
    words = [b" ".join([b"%d" % len(v), *v]) if isinstance(v, list) else v for v in values]
    return b" ".join(words) + b"\n"


def _read_binary(data: bytes, layout: _Layout) -> _Body:
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
    for _ in range(0 if _has_triangles_only(data, start, layout) else face.count):
        row: list[Any] = []
        for _, length_type, kind in face.properties:
            length = 1
            if length_type is not None:
                (length,) = struct.unpack_from(order + length_type, data, position)
                position += struct.calcsize(length_type)
            values = struct.unpack_from(f"{order}{int(length)}{kind}", data, position)
            position += struct.calcsize(kind) * int(length)
            row.append(values[0] if length_type is None else values)
        rows.append(row)
    return vertices, rows, start, position


def _pack(values: list[Any], layout: _Layout) -> bytes:
    packed = b""
    for (_, length_type, kind), value in zip(layout.face.properties, values, strict=True):
        if length_type is not None:
            packed += struct.pack(layout.order + length_type, len(value))
        each = [value] if length_type is None else value
        packed += struct.pack(f"{layout.order}{len(each)}{kind}", *each)
    return packed


def _has_triangles_only(data: bytes, start: int, layout: _Layout) -> bool:
    """Whether all faces have three corners: a quick test that may miss some files of triangles."""
    face, order = layout.face, layout.order
    if sum(length is not None for _, length, _ in face.properties) > 1:
        return False
    fields: list[Any] = [(f"other{index}", order + kind) for index, (_, _, kind) in enumerate(face.properties)]
    _, length, kind = face.properties[layout.corners]
    fields[layout.corners : layout.corners + 1] = [("corners", f"{order}{length}"), ("indices", order + kind, (3,))]
    row_type = np.dtype(fields)
    if start + face.count * row_type.itemsize > len(data):
        return False
    return bool((np.frombuffer(data, row_type, face.count, start)["corners"] == 3).all())
