"""Names of types that many signatures share."""

from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

Fields = dict[str, Any]
"""Values by name, such as an object of JSON."""

Document = Mapping[str, Any]
"""An object of JSON that is only read."""

PathName = str | PathLike[str]
"""The path of a file."""

Size = tuple[int, int]
"""Height and width in px."""
