"""A bounded reader for MATLAB 5 annotation files.

``scipy.io.loadmat`` is not used because files are untrusted: a number of an unknown type or a
deeply nested cell ends the process by a segmentation fault, and 200 bytes that claim a large array
take all memory. This reader knows structs, text and real numbers; all else (cells, objects, sparse)
becomes None.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from ..errors import MAX_MAT_BYTES, InvalidInputError
from ..utils.arrays import Floats

MatStruct = dict[str, "MatValue"]
MatValue = list[MatStruct] | str | Floats | None
"""A struct array, a text, real numbers in MATLAB's column order, or None for any other type."""

MAX_DEPTH = 16
"""Nesting of structs."""

_MATRIX = 14
_COMPRESSED = 15
_STRUCT = 2
_CHAR = 4
_NUMERIC = range(6, 16)
_COMPLEX = 0x0800
_NUMBERS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_CODECS = {
    1: "latin-1",
    2: "latin-1",
    4: "utf-16-le",
    16: "utf-8",
    17: "utf-16-le",
    18: "utf-32-le",
}


def read_mat(path: Path, variable: str) -> MatValue:
    """Return the value of ``variable`` in a little-endian MATLAB 5 to 7.2 file.

    Raises:
        InvalidInputError: any other file, a damaged one, or one of more than ``MAX_MAT_BYTES``,
            packed or not.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_MAT_BYTES + 1)
        if len(data) > MAX_MAT_BYTES:
            raise ValueError(f"larger than {MAX_MAT_BYTES:,} bytes, no annotation")
        if data[124:128] != b"\0\1IM":
            raise ValueError("expected version 0x0100, little-endian")
        for name, value in _variables(data[128:]):
            if name == variable:
                return value
        raise ValueError(f"holds no variable {variable!r}")
    except (OSError, ValueError, struct.error, zlib.error) as error:
        raise InvalidInputError(
            f"not a MATLAB 5 file, or damaged: {error}", subject=path
        ) from error


def _variables(data: bytes) -> Iterator[tuple[str, MatValue]]:
    remaining = MAX_MAT_BYTES
    for kind, body in _elements(data, padded=False):
        if kind == _COMPRESSED:
            stream = zlib.decompressobj()
            unpacked = stream.decompress(body, remaining)
            remaining -= len(unpacked)
            if not stream.eof or remaining <= 0:
                raise ValueError(f"truncated, or unpacks to more than {MAX_MAT_BYTES:,} bytes")
            kind, body = next(_elements(unpacked), (0, b""))
        if kind == _MATRIX:
            yield _array(body, MAX_DEPTH)


def _elements(data: bytes, *, padded: bool = True) -> Iterator[tuple[int, bytes]]:
    """Types and contents of the tagged elements in sequence."""
    position = 0
    while position + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, position)
        start = position + 8
        end = position + 8 + size + (-size % 8 if padded else 0)
        if kind >> 16:  # small form: size and type share a word, content in the next four bytes
            kind, size, start, end = kind & 0xFFFF, kind >> 16, position + 4, position + 8
        if start + size > len(data) or start + size > end:
            raise ValueError("ends inside an element")
        yield kind, data[start : start + size]
        position = end


def _array(body: bytes, depth: int) -> tuple[str, MatValue]:
    """Name and value of an array."""
    if not body:
        return "", np.empty(0)
    if depth == 0:
        raise ValueError(f"nested more than {MAX_DEPTH} deep")
    elements = _elements(body)
    (_, flags), (_, sizes), (_, label) = islice(elements, 3)
    flag = struct.unpack_from("<I", flags)[0]
    name = label.decode("latin-1")
    count = math.prod(struct.unpack(f"<{len(sizes) // 4}i", sizes))
    if flag & 0xFF == _STRUCT:
        return name, _structs(elements, count, len(body), depth)
    kind, content = next(elements, (0, b""))
    if flag & 0xFF == _CHAR:
        if kind not in _CODECS:
            raise ValueError(f"text of unknown type {kind}")
        return name, content.decode(_CODECS[kind])
    if flag & 0xFF not in _NUMERIC or flag & _COMPLEX:
        return name, None
    if kind not in _NUMBERS:
        raise ValueError(f"numbers of unknown type {kind}")
    numbers = np.frombuffer(content, "<" + _NUMBERS[kind]).astype(np.float64)
    if len(numbers) != count:
        raise ValueError(f"an array claims {count} numbers, holds {len(numbers)}")
    return name, numbers


def _structs(
    elements: Iterator[tuple[int, bytes]], count: int, size: int, depth: int
) -> list[MatStruct]:
    (_, content), (_, names) = islice(elements, 2)
    (width,) = struct.unpack_from("<i", content)
    if width < 1:
        raise ValueError(f"field names of {width} bytes")
    starts = range(0, len(names) - width + 1, width)
    fields = [names[i : i + width].split(b"\0")[0].decode("latin-1") for i in starts]
    if not 0 <= count * max(1, len(fields)) * 8 <= size:  # every value has a tag of 8 bytes
        raise ValueError(f"a struct array claims {count} x {len(fields)} values")
    values: list[MatStruct] = []
    for _ in range(count):
        value: MatStruct = {}
        for field in fields:
            kind, content = next(elements, (0, b""))
            if kind != _MATRIX:
                raise ValueError(f"field {field!r} is no array")
            value[field] = _array(content, depth - 1)[1]
        values.append(value)
    return values
