"""Objects without what follows from the rest of them."""

from functools import cached_property

from .aliases import Fields


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
