"""JSON files of others."""

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError, MissingFileError
from ..limits import MAX_TABLE_BYTES

__all__ = ["check_table_size", "finite_numbers", "read_json"]


def read_json(path: Path, kind: type[Any], readme: str) -> Any:
    """The content of ``path``, which must be a ``kind`` (dict or list) at the top."""
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file; {readme} shows the layout")
    check_table_size(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"{path}: damaged ({error})") from error
    if not isinstance(content, kind):
        raise InvalidInputError(f"{path}: expected a {kind.__name__}, got a {type(content).__name__}")
    return content


def check_table_size(path: Path) -> None:
    """``path`` is not larger than a table that is read whole may be."""
    if path.stat().st_size > MAX_TABLE_BYTES:
        raise InvalidInputError(f"{path}: larger than {MAX_TABLE_BYTES:,} bytes; split the set")


def finite_numbers(values: object, count: int) -> tuple[float, ...] | None:
    """``values`` as floats if it is a list of ``count`` finite numbers, else None."""
    if not isinstance(values, Iterable) or isinstance(values, str | dict):
        return None
    numbers = list(values)
    if len(numbers) != count or any(isinstance(v, bool) or not isinstance(v, int | float) for v in numbers):
        return None
    try:
        floats = tuple(float(v) for v in numbers)
    except OverflowError:
        return None
    return floats if all(map(math.isfinite, floats)) else None
