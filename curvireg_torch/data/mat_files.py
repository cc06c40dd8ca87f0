"""A bounded reader for MATLAB 5 annotation files.

It replaces ``scipy.io.loadmat``, which crashes on deeply nested cells and allocates whatever size a header claims. It
reads structs, text and real numbers, with bounds on depth and size; all else (cells, objects, sparse) becomes None.
"""

import math
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import MAX_MAT_BYTES, MAX_MAT_DEPTH, MAX_MAT_UNPACKED_BYTES, InvalidInputError

MatStruct = dict[str, "MatValue"]
MatValue = list[MatStruct] | str | NDArray[np.float64] | None
"""A struct array, a text, real numbers in MATLAB's column order, or None for any other type."""

_MATRIX, _COMPRESSED, _INT32, _UINT32 = 14, 15, 5, 6
_STRUCT, _CHAR, _NUMERIC = 2, 4, range(6, 16)
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_COMPLEX = 0x0800


def read_mat(path: Path, variable: str) -> MatValue:
    """The value of ``variable`` in a MATLAB 5 to 7.2 file; :class:`InvalidInputError` for any other file."""
    try:
        if path.stat().st_size > MAX_MAT_BYTES:
            raise InvalidInputError(f"larger than {MAX_MAT_BYTES} bytes, not an annotation")
        data = path.read_bytes()
        order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
        if order is None or data[124:126] not in (b"\x00\x01", b"\x01\x00"):
            raise InvalidInputError("expected a MATLAB 5 file, version 0x0100")
        return _find(data[128:], variable, order)
    except (OSError, struct.error, zlib.error, UnicodeError) as error:
        raise InvalidInputError(f"damaged ({error})", subject=path) from error
    except InvalidInputError as error:
        raise error.with_subject(path) from None


def _find(data: bytes, variable: str, order: str) -> MatValue:
    position, remaining = 0, MAX_MAT_UNPACKED_BYTES
    while position + 8 <= len(data):
        kind, body, position = _element(data, position, order, padded=False)
        if kind == _COMPRESSED:
            stream = zlib.decompressobj()
            unpacked = stream.decompress(body, remaining)
            remaining -= len(unpacked)
            if not stream.eof or remaining <= 0:
                raise InvalidInputError(f"truncated, or unpacks to more than {MAX_MAT_UNPACKED_BYTES} bytes")
            kind, body, _ = _element(unpacked, 0, order)
        if kind == _MATRIX:
            name, value = _array(body, order, MAX_MAT_DEPTH, variable=variable)
            if name == variable:
                return value
    raise InvalidInputError(f"holds no variable {variable!r}")


def _element(data: bytes, position: int, order: str, *, padded: bool = True) -> tuple[int, bytes, int]:
    """Type, content and end of the tagged element at ``position``."""
    (word,) = struct.unpack_from(order + "I", data, position)
    if word >> 16:  # small form: size and type share a word, content in the next four bytes
        kind, size, start, end = word & 0xFFFF, word >> 16, position + 4, position + 8
        if size > 4:
            raise InvalidInputError(f"small element of {size} bytes")
    else:
        kind, start = word, position + 8
        (size,) = struct.unpack_from(order + "I", data, position + 4)
        end = start + size + (-size % 8 if padded else 0)
    if start + size > len(data):
        raise InvalidInputError("ends inside an element")
    return kind, data[start : start + size], end


def _array(body: bytes, order: str, depth: int, variable: str | None = None) -> tuple[str, MatValue]:
    """Name and value of an array; the value of any but ``variable`` is not read."""
    if not body:
        return "", np.empty(0)
    if depth == 0:
        raise InvalidInputError(f"nested more than {MAX_MAT_DEPTH} deep")
    kind, flags, position = _element(body, 0, order)
    if kind != _UINT32 or len(flags) < 4:
        raise InvalidInputError("array without flags")
    (flag,) = struct.unpack_from(order + "I", flags)
    kind, content, position = _element(body, position, order)
    if kind not in (_INT32, _UINT32):  # some writers use the unsigned type
        raise InvalidInputError("array without dimensions")
    count = math.prod(struct.unpack(f"{order}{len(content) // 4}i", content))
    _, content, position = _element(body, position, order)
    name = content.decode("latin-1")
    array_class = flag & 0xFF
    if count < 0:
        raise InvalidInputError("array of negative size")
    if variable is not None and name != variable:
        return name, None
    if array_class == _STRUCT:
        return name, _struct(body, position, order, depth, count)
    if array_class == _CHAR:
        return name, _text(*_element(body, position, order)[:2], order)
    if array_class in _NUMERIC and not flag & _COMPLEX:
        return name, _numbers(*_element(body, position, order)[:2], order, count)
    return name, None


def _struct(body: bytes, position: int, order: str, depth: int, count: int) -> list[MatStruct]:
    _, content, position = _element(body, position, order)
    (width,) = struct.unpack_from(order + "i", content)
    _, content, position = _element(body, position, order)
    if width < 1:
        raise InvalidInputError(f"field names of {width} bytes")
    starts = range(0, len(content) - width + 1, width)
    fields = [content[i : i + width].split(b"\0")[0].decode("latin-1") for i in starts]
    if not fields:
        return []
    if count * len(fields) * 8 > len(body) - position:  # every value has a tag of 8 bytes
        raise InvalidInputError(f"struct array claims {count} x {len(fields)} values")
    values: list[MatStruct] = []
    for _ in range(count):
        value: MatStruct = {}
        for field in fields:
            kind, content, position = _element(body, position, order)
            if kind != _MATRIX:
                raise InvalidInputError(f"field {field!r} is no array")
            value[field] = _array(content, order, depth - 1)[1]
        values.append(value)
    return values


def _text(kind: int, content: bytes, order: str) -> str:
    wide = "le" if order == "<" else "be"
    codecs = {1: "latin-1", 2: "latin-1", 4: f"utf-16-{wide}", 16: "utf-8", 17: f"utf-16-{wide}", 18: f"utf-32-{wide}"}
    if kind not in codecs:
        raise InvalidInputError(f"text of unknown type {kind}")
    return content.decode(codecs[kind])


def _numbers(kind: int, content: bytes, order: str, count: int) -> NDArray[np.float64]:
    if kind not in _NUMBERS:
        raise InvalidInputError(f"numbers of unknown type {kind}")
    dtype = np.dtype(order + _NUMBERS[kind])
    if len(content) != count * dtype.itemsize:
        raise InvalidInputError(f"array claims {count} numbers, holds {len(content) / dtype.itemsize:g}")
    return np.frombuffer(content, dtype).astype(np.float64)
