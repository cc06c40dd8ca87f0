"""STL files, binary and ASCII; whatever a binary header says.

trimesh 5.2 reads whole files as well. This reader says of others that they were cut, or have
decimal commas, and reads trailing bytes and names in Latin-1; once trimesh does, it can go.
"""

import re

import numpy as np

from ...utils.arrays import Floats
from .source import MeshSource, ReadMesh, numbers, plain_text

# Bytes before the faces of a binary file, and of each face
_HEADER = 84
_FACE = 50
_TEXT = 512  # Bytes of which one is 0, or no ASCII, in any binary file
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"^[ \t]*+vertex[ \t]++([^\n]*+)", re.MULTILINE)
_FACET = re.compile(rb"^[ \t]*+facet\b", re.MULTILINE)
_END_OF_FACET = re.compile(rb"^[ \t]*+end[ \t]*+facet\b", re.MULTILINE)
_END = re.compile(rb"^[ \t]*+end[ \t]*+solid\b", re.MULTILINE)


def read_stl(source: MeshSource) -> ReadMesh:
    """Read an STL file; three vertices for each face."""
    data = source.data()
    is_binary = _is_binary(data)
    corners = _binary(source, data) if is_binary else _ascii(source, plain_text(data).lower())
    return ReadMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def _is_binary(data: bytes) -> bool:
    """Binary headers may begin with "solid" too: the length decides, then what follows."""
    if len(data) >= _HEADER:
        claimed = int.from_bytes(data[80:84], "little")
        if len(data) == _HEADER + _FACE * claimed:
            return True
    start = plain_text(data[:4096]).lower()
    return not (start.lstrip().startswith(b"solid") and b"\0" not in start)


def _binary(source: MeshSource, data: bytes) -> Floats:
    """(3 F, 3) corners of the faces."""
    start = data[:_TEXT]
    if len(data) < _HEADER or (start.isascii() and b"\0" not in start):
        raise ValueError("the file ends too early, or is no STL file")
    claimed = int.from_bytes(data[80:84], "little")
    whole = (len(data) - _HEADER) // _FACE
    if claimed > whole or (claimed == 0 and whole):
        raise ValueError(
            f"it says {claimed:,} faces and holds {whole:,}: it was cut while it was written"
        )
    if whole > claimed:
        source.warn(
            "cut", f"it says {claimed:,} faces and holds {whole:,}: the others are left out"
        )
    records = np.frombuffer(data, _RECORD, claimed, _HEADER)
    return np.asarray(records["corners"].reshape(-1, 3), np.float64)


def _ascii(source: MeshSource, text: bytes) -> Floats:
    lines = _VERTEX.findall(text)
    values = numbers(b"\n".join(lines))
    facets = len(_FACET.findall(text))
    if len(lines) != 3 * facets or len(_END_OF_FACET.findall(text)) != facets:
        raise ValueError(
            "it ends within a face, or has faces that are no triangles: it was cut short, or is "
            "damaged"
        )
    if _END.search(text) is None:
        source.warn(
            "cut", "it does not end with endsolid: it may have been cut short, and lack faces"
        )
    if len(values) != 9 * facets:
        raise ValueError("a vertex does not have three coordinates")
    return values.reshape(-1, 3)
