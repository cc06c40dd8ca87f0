"""JSON files, read within limits."""

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ..errors import MAX_TABLE_BYTES, InvalidInputError, MissingFileError


def read_json(path: Path, kind: type[Any], readme: str) -> Any:
    """The content of a JSON file whose top level must be a ``kind`` (dict or list)."""
    if not path.is_file():
        raise MissingFileError(f"no such file; {readme} shows the layout", subject=path)
    check_table_size(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"damaged, or not JSON ({error}); {readme} shows the layout", subject=path) from error
    if not isinstance(content, kind):
        expected = "an object" if kind is dict else "a list"
        raise InvalidInputError(f"expected {expected} of JSON; {readme} shows the layout", subject=path)
    return content


def check_table_size(path: Path) -> None:
    """Refuse a table that is too large to be read as a whole."""
    if path.stat().st_size > MAX_TABLE_BYTES:
        raise InvalidInputError(f"larger than {MAX_TABLE_BYTES:,} bytes; split the set", subject=path)


def finite_numbers(values: object, count: int) -> tuple[float, ...] | None:
    """``values`` as floats if they are ``count`` finite numbers, else None."""
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
