"""MATLAB 5 annotation files, read by SciPy within limits."""

import math
import struct
import threading
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

from ..errors import MAX_MAT_BYTES, InvalidInputError

_MATRIX, _COMPRESSED = 14, 15
_STACK_BYTES = 1 << 27
"""SciPy recurses in C: about 2 kB for each of the MAX_MAT_BYTES / 48 structs that a file may nest."""


def read_mat(path: Path, variable: str) -> Any:
    """Return ``variable`` of a little-endian MATLAB 5 to 7.2 file as dicts, lists, texts, numbers and arrays.

    Raises:
        InvalidInputError: any other file, a damaged one, or one that unpacks to more than ``MAX_MAT_BYTES``.
    """
    found: list[Any] = []

    def read() -> None:
        from scipy.io import loadmat

        try:
            with path.open("rb") as file:
                data = _unpacked(file.read(MAX_MAT_BYTES + 1))
            found.append(loadmat(BytesIO(data), variable_names=[variable], simplify_cells=True)[variable])
        except KeyError:
            found.append(InvalidInputError(f"holds no variable {variable!r}", subject=path))
        except Exception as error:  # SciPy raises errors of any kind for damaged files
            found.append(InvalidInputError(f"not a MATLAB 5 file, or damaged ({error})", subject=path))

    before = threading.stack_size(_STACK_BYTES)  # deeply nested structs would overflow a usual stack
    try:
        thread = threading.Thread(target=read)
        thread.start()
    finally:
        threading.stack_size(before)
    thread.join()
    if isinstance(found[0], InvalidInputError):
        raise found[0]
    return found[0]


def _unpacked(data: bytes) -> bytes:
    """The file without compression, in which no array claims more values than the file has bytes."""
    if data[124:128] != b"\0\1IM":
        raise ValueError("expected version 0x0100, little-endian")
    parts, size, position = [data[:128]], 128, 128
    while position + 8 <= len(data) and max(size, len(data)) <= MAX_MAT_BYTES:
        kind, length = struct.unpack_from("<II", data, position)
        element = data[position : position + 8 + length]
        if kind == _COMPRESSED:
            element = zlib.decompressobj().decompress(element[8:], MAX_MAT_BYTES)
        _check_claims(element)
        parts.append(element)
        size, position = size + len(element), position + 8 + length
    if max(size, len(data)) > MAX_MAT_BYTES:
        raise ValueError(f"more than {MAX_MAT_BYTES:,} bytes, no annotation")
    return b"".join(parts)


def _check_claims(element: bytes) -> None:
    """Refuse dimensions for which SciPy would allocate memory before it reads a value; walks as SciPy does."""
    position, is_dimensions = 0, False
    while position + 8 <= len(element):
        kind, length = struct.unpack_from("<II", element, position)
        if kind == _MATRIX:  # flags of 16 bytes and the dimensions follow, then what is nested, in sequence
            position, is_dimensions = position + (24 if length else 8), length > 0
            continue
        is_small = kind >> 16  # four bytes of content in place of the length
        if is_dimensions:
            sizes = (length,) if is_small else struct.unpack_from(f"<{min(length, 128) // 4}i", element, position + 8)
            if abs(math.prod(sizes)) > len(element):
                raise ValueError(f"an array claims the size {sizes}")
        position, is_dimensions = position + (8 if is_small else 8 + length + -length % 8), False
    if position != len(element):
        raise ValueError("ends inside an element")
