"""OFF files, rewritten with triangles in place of polygons; colours of faces stay."""

import re

import numpy as np

from .polygons import check_face_count, check_line_count, divide_faces


def with_triangles(data: bytes) -> bytes:
    """The content of an OFF file with every face a triangle; the same bytes if all are."""
    header, _, rest = re.sub(rb"#[^\r\n]*", b"", data).partition(b"OFF")
    check_line_count(rest)
    lines = [line for line in rest.splitlines() if line.strip()]
    if len(header) > 16 or not lines:
        raise ValueError("not an OFF file")
    V, F = (int(n) for n in lines[0].split()[:2])
    if V < 0 or F < 0 or len(lines) < 1 + V + F:
        raise ValueError("the file ends too early")
    check_face_count(F)
    words = [line.split() for line in lines[1 + V : 1 + V + F]]
    if all(line[0] == b"3" for line in words):
        return data
    faces = [[int(n) for n in line[1 : 1 + int(line[0])]] for line in words]
    vertices = np.array([line.split()[:3] for line in lines[1 : 1 + V]], dtype=np.float64).reshape(-1, 3)
    rows = []
    for face, triangles in divide_faces(vertices, faces):
        colour = words[face][1 + len(faces[face]) :]
        rows += [b" ".join([b"3", *(words[face][1 + i] for i in triangle), *colour]) for triangle in triangles]
    return b"\n".join([b"OFF", b"%d %d 0" % (V, len(rows)), *lines[1 : 1 + V], *rows, b""])
