"""Names of types that many signatures share; those of arrays are in :mod:`.arrays`."""

from collections.abc import Mapping
from os import PathLike
from typing import Any

Fields = dict[str, Any]
"""Values by name, such as an object of JSON."""

Document = Mapping[str, Any]
"""An object of JSON that is only read."""

PathName = str | PathLike[str]
"""The path of a file."""

Size = tuple[int, int]
"""Height and width in px."""
