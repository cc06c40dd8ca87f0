"""Names of types that many signatures share; those of arrays are in :mod:`.arrays`."""

from collections.abc import Callable, Mapping
from os import PathLike
from typing import Any

Fields = dict[str, Any]
"""Values by name, such as an object of JSON."""

Document = Mapping[str, Any]
"""An object of JSON that is only read."""

PathName = str | PathLike[str]
"""The path of a file."""

Progress = Callable[[str, int, int], object]
"""Is called with a stage, and how much of it is done, of how much in all."""

Size = tuple[int, int]
"""Height and width in px."""
