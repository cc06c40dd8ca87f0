"""Limits on the pose as users write them: options of the command line, cells of a list."""

import re
from collections.abc import Mapping
from typing import Any

from ..errors import InvalidInputError
from ..geometry.pose_prior import PosePrior

__all__ = ["PRIOR_OPTIONS", "QUALIFIERS", "limits_from_cells", "limits_from_options", "prior_from_limits"]

PRIOR_OPTIONS = ("azimuth", "elevation", "theta", "side", "near", "within", "distance", "front")
"""Names of the options, and of the columns."""

WITHIN = 45.0
"""Degrees of ``within`` beside ``near`` if none are given."""

QUALIFIERS = {"front"}
"""Arguments that limit nothing by themselves."""

_TEXTS = ("side", "front")


def limits_from_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of :class:`PosePrior`, of which ``side`` and ``near`` are shorter forms; None means: not given.

    Raises:
        InvalidInputError: ``side`` beside ``azimuth``, ``within`` without ``near``, or a ``near`` of other than two or
            three numbers.

    Example:
        >>> limits_from_options({"side": "front", "near": (10, 20)})
        {'azimuth': (315.0, 45.0), 'viewpoint': (10, 20, 0.0), 'within': 45.0}
    """
    given = {name: options[name] for name in PRIOR_OPTIONS if options.get(name) is not None}
    given = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    side, near, within = (given.pop(name, None) for name in ("side", "near", "within"))
    if side is not None:
        if "azimuth" in given:
            raise InvalidInputError("side: give it or azimuth")
        given["azimuth"] = PosePrior.side(side).azimuth
    if near is not None:
        if len(near) not in (2, 3):
            raise InvalidInputError(f"near: expected AZIMUTH ELEVATION [THETA], got {len(near)} numbers")
        given |= {"viewpoint": (*near, 0.0)[:3], "within": WITHIN if within is None else within}
    elif within is not None:
        raise InvalidInputError("within: expected near beside it")
    return given


def limits_from_cells(cells: Mapping[str, str]) -> dict[str, Any]:
    """:func:`limits_from_options` of texts such as "300 60"; empty ones are not given.

    Example:
        >>> limits_from_cells({"azimuth": "300 60", "theta": "", "front": "-y"})
        {'azimuth': (300.0, 60.0), 'front': '-y'}
    """
    return limits_from_options({name: _value(name, text) for name, text in cells.items() if text})


def _value(name: str, text: str) -> Any:
    if name in _TEXTS:
        return text
    try:
        numbers = tuple(map(float, re.split(r"[\s,]+", text.strip("[] "))))
    except ValueError:
        raise InvalidInputError(f"{name}: expected numbers with blanks between them, got {text[:40]!r}") from None
    if name != "within":
        return numbers
    if len(numbers) != 1:
        raise InvalidInputError(f"{name}: expected one number, got {text[:40]!r}")
    return numbers[0]


def prior_from_limits(limits: Mapping[str, Any]) -> PosePrior | None:
    """The prior with these arguments; None if they limit nothing."""
    return PosePrior(**limits) if limits.keys() - QUALIFIERS else None
