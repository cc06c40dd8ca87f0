"""Bounds on what a mesh file may hold, and what is said of one beyond them."""

from ...errors import MAX_MESH_FACES, MAX_MESH_LINES, MAX_MESH_PARTS
from ...utils.arrays import Integers


def check_faces(count: float) -> None:
    """Refuse too many triangles."""
    if count > MAX_MESH_FACES:
        raise ValueError(f"more than {MAX_MESH_FACES:,} faces; simplify it")


def check_parts(count: int) -> None:
    """Refuse too many parts."""
    if count > MAX_MESH_PARTS:
        raise ValueError(f"more than {MAX_MESH_PARTS:,} parts; join them")


def check_lines(data: bytes) -> None:
    """Refuse a text of too many lines, each of which takes more memory than it has bytes."""
    if max(data.count(b"\n"), data.count(b"\r")) > MAX_MESH_LINES:
        raise ValueError(f"more than {MAX_MESH_LINES:,} lines; simplify it")


def check_corners(corners: Integers, count: int, what: str = "a vertex") -> None:
    """Refuse corners of faces that are none of the ``count`` first natural numbers."""
    if corners.size and not 0 <= corners.min() <= corners.max() < count:
        raise ValueError(f"a face names {what} that the file lacks")
