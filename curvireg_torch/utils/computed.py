"""What objects compute once, and objects without it."""

from collections.abc import Callable
from functools import cached_property, wraps
from typing import Any, TypeVar, TypeVarTuple

from .aliases import Fields

Given = TypeVarTuple("Given")
Value = TypeVar("Value")


def remembered(method: Callable[[Any, *Given], Value]) -> Callable[[Any, *Given], Value]:
    """Decorate a method of hashable arguments: its object keeps the value for each of them.

    Example:
        >>> class Squares:
        ...     @remembered
        ...     def of(self, number):
        ...         print("computed")
        ...         return number**2
        >>> squares = Squares()
        >>> squares.of(3), squares.of(3)
        computed
        (9, 9)
    """
    name = f"values of {method.__name__}"

    @wraps(method)
    def value_of(self: Any, *given: *Given) -> Value:
        known: dict[tuple[*Given], Value] = vars(self).setdefault(name, {})
        if given not in known:
            known[given] = method(self, *given)
        return known[given]

    return value_of


def without_computed(thing: object) -> Fields:
    """The attributes of an object but for those that its cached properties have computed.

    Example:
        >>> class Square:
        ...     side = 2.0
        ...     area = cached_property(lambda self: self.side**2)
        >>> square = Square()
        >>> square.area, without_computed(square)
        (4.0, {})
    """
    of_classes = [vars(one).items() for one in type(thing).__mro__]
    computed = {name for items in of_classes for name, x in items if isinstance(x, cached_property)}
    return {name: value for name, value in vars(thing).items() if name not in computed}
