"""OBJ files, rewritten with triangles in place of polygons; all else in the file stays as it is."""

import re

import numpy as np

from .polygons import check_line_count, divide_faces

_NEEDS_REWRITING = re.compile(rb"^f[ \t]+(?:(?:[^ \t\r\n]+[ \t]+){3}[^ \t\r\n#]|[^\r\n]*-)", re.MULTILINE)
"""A face of more than three corners, or with indices that count back from the end."""


def with_triangles(data: bytes) -> bytes:
    """The content of an OBJ file with every face a triangle; the same bytes if all are."""
    data = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    if _NEEDS_REWRITING.search(data) is None:
        return data
    check_line_count(data)
    lines = data.splitlines()
    vertices: list[list[bytes]] = []
    counts, corners_of, faces = {b"v": 0, b"vt": 0, b"vn": 0}, [], []
    for number, line in enumerate(lines):
        words = line.split(b"#")[0].split()
        key = words[0] if words else b""
        if key == b"v":
            vertices.append(words[1:4])
        if key in counts:
            counts[key] += 1
        elif key == b"f":
            corners = [_absolute(word, counts) for word in words[1:]]
            corners_of.append((number, corners))
            faces.append([int(corner.split(b"/")[0]) - 1 for corner in corners])
            lines[number] = b""
    for face, triangles in divide_faces(np.array(vertices, dtype=np.float64).reshape(-1, 3), faces):
        number, corners = corners_of[face]
        lines[number] = b"\n".join(b"f " + b" ".join(corners[i] for i in triangle) for triangle in triangles)
    return b"\n".join(lines) + b"\n"


def _absolute(corner: bytes, counts: dict[bytes, int]) -> bytes:
    """``v/vt/vn`` with negative indices, which count back from the current line, counted from 1."""
    if b"-" not in corner:
        return corner
    indices = zip(corner.split(b"/"), counts.values(), strict=False)
    return b"/".join(b"%d" % (count + 1 + int(i)) if i.startswith(b"-") else i for i, count in indices)
