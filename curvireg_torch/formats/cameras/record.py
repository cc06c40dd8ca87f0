"""The keys and values of one camera in a calibration file, and which of them were read."""

import re
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ...errors import InvalidInputError
from ...utils.aliases import Document, Size
from ...utils.files import finite_numbers
from ..documents import number

Used = set[tuple[int, str]]
"""Keys that were read, each with the identity of its dict."""

_DISTORTION_KEY = re.compile(
    r"([kp]\d|[bs][1-4]|d|kc|xi|tau[xy])$"  # coefficients and vectors of them
    r"|dist(?!ance|r)|radial|tangential|thinprism|affin"
    r"|(?!undist|perframeintrinsic|num).*(distort|coef|skew)"
)
"""Keys, without case and punctuation, whose numbers describe a lens."""


def plain(key: str) -> str:
    """A key without case and punctuation: "dist_coeffs" and "distCoeffs" are the same."""
    return re.sub(r"[^a-z0-9]", "", key.lower())


@dataclass(frozen=True)
class CameraRecord:
    """A camera of a calibration file: pixels count from the centre of the first one, x right, y
    down.

    Attributes:
        matrix: 3 x 3, in px.
        distortion: coefficients in OpenCV's order.
        model: "radial-tangential", or "fisheye" for the equidistant one of ``cv2.fisheye``.
        size: (H, W) of the pictures; None if the file does not state it.
        focal_deviation: standard deviation of the focal length, as a fraction of it; 0 of a known
            one.
        source: "given", or "estimated" in a photograph.
    """

    matrix: tuple[tuple[float, ...], ...]
    distortion: tuple[float, ...] = ()
    model: str = "radial-tangential"
    size: Size | None = None
    focal_deviation: float = 0.0
    source: str = "given"


class Record:
    """A dict of a calibration, and those around it, which are asked for keys that it lacks.

    Args:
        values: the dict.
        used: gets the keys that are read.
        around: enclosing dicts, the innermost first.
    """

    def __init__(self, values: Document, used: Used, around: Sequence[Document] = ()) -> None:
        self.values = values
        self.used = used
        self.around = around

    def has(self, *names: str) -> bool:
        """Whether the dict itself has one of the keys."""
        return not set(map(plain, names)).isdisjoint(map(plain, self.values))

    def matches(self, rule: str) -> bool:
        """Whether the dict itself has the keys of a rule: all of its words, of ``a|b`` one of the
        two, and none of ``!a``."""
        return all(
            self.has(*word.lstrip("!").split("|")) != word.startswith("!") for word in rule.split()
        )

    def lengths(self, *names: str) -> list[int]:
        """How many values each of the keys holds that the dict itself has."""
        wanted = set(map(plain, names))
        return [len(flattened(x)) for key, x in self.values.items() if plain(key) in wanted]

    def get(self, *names: str) -> Any:
        """The value of the first key that is one of the names; None without one."""
        for values in (self.values, *self.around):
            keys = {plain(key): key for key in values}
            for name in names:
                if (key := keys.get(plain(name))) is not None and values[key] is not None:
                    self.used.add((id(values), key))
                    return values[key]
        return None

    def numbers(self, *names: str) -> list[float]:
        """The finite numbers of the first of some keys, of a matrix row by row; none without such a
        key."""
        flat = flattened(self.get(*names))
        found = finite_numbers(flat, len(flat))
        if found is None:
            raise InvalidInputError(f"{names[0]}: expected finite numbers, got {flat!r:.80}")
        return list(found)

    def number(self, *names: str) -> float | None:
        """The number of the first of some keys, or None."""
        found = self.numbers(*names)
        return found[0] if len(found) == 1 else None

    def words(self, *names: str) -> list[str]:
        """The texts of those of the keys that have one."""
        return [text for name in names if isinstance(text := self.get(name), str)]

    def inside(self, *names: str) -> "Record | None":
        """The dict that is the value of one of the keys."""
        values = self.get(*names)
        return Record(values, self.used) if isinstance(values, dict) else None


def flattened(value: Any) -> list[Any]:
    """The scalars of nested lists, and of the ``data``, or the x and y, of a dict; texts that are
    numbers are these."""
    while isinstance(value, dict):
        value = [value["x"], value["y"]] if value.keys() == {"x", "y"} else value.get("data")
    if isinstance(value, list):
        return [scalar for item in value for scalar in flattened(item)]
    if isinstance(value, str):
        words = [number(word) for word in value.split()]
        return words if words and not any(isinstance(word, str) for word in words) else [value]
    return [] if value is None else [value]


def distortion_keys(value: Any, others: Container[int]) -> Iterator[tuple[int, str]]:
    """The keys that look like distortion and have a number that is not zero, each with the identity
    of its dict.

    Args:
        value: a document, or a part of it.
        others: identities of dicts that do not count.
    """
    if isinstance(value, list):
        for item in value:
            yield from distortion_keys(item, others)
    if isinstance(value, dict) and id(value) not in others:
        yield from distortion_keys_inside(value, others)


def distortion_keys_inside(values: Document, others: Container[int]) -> Iterator[tuple[int, str]]:
    """:func:`distortion_keys` of a dict that counts, whoever else it belongs to."""
    for key, value in values.items():
        name = plain(key)
        if name == "covariance":
            continue
        is_camera = id(value) in others
        is_projection = name in ("p1", "p2") and len(flattened(value)) == 12
        is_lens = _DISTORTION_KEY.match(name) and not is_projection
        if not is_camera and is_lens and _has_number(value):
            yield id(values), key
        yield from distortion_keys(value, others)


def _has_number(value: Any) -> bool:
    """Whether a value holds a number that is not zero."""
    if isinstance(value, dict):
        return any(map(_has_number, value.values()))
    numbers = (scalar for scalar in flattened(value) if isinstance(scalar, int | float))
    return any(scalar != 0 and not isinstance(scalar, bool) for scalar in numbers)
