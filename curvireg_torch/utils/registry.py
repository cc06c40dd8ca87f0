"""One way to plug in: named fields, terms, renderers, datasets and detectors."""

from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from typing import Any, Generic, TypeVar, overload

from ..errors import InvalidInputError

__all__ = ["Registry", "resolve"]

T = TypeVar("T")
D = TypeVar("D")


def resolve(target: T | str) -> T:
    """Import a target that is given as "package.module:attribute"; any other object is returned unchanged."""
    if not isinstance(target, str):
        return target
    module, _, attribute = target.partition(":")
    found: T = getattr(import_module(module), attribute)
    return found


class Registry(Mapping[str, T], Generic[T]):
    """Objects by name, in the order of registration. An object may be imported only when it is first used.

    Args:
        kind: what the objects are, for error messages.
        entries: name -> object, or "package.module:attribute" of one.

    Example:
        >>> shapes = Registry("shape", {"fraction": "fractions:Fraction"})
        >>> @shapes.register("pair")
        ... def make_pair():
        ...     return (1, 2)
        >>> list(shapes), shapes["pair"](), shapes["fraction"](1, 2)
        (['fraction', 'pair'], (1, 2), Fraction(1, 2))
    """

    def __init__(self, kind: str, entries: Mapping[str, T | str] | None = None) -> None:
        self.kind = kind
        self._entries: dict[str, T | str] = dict(entries or {})

    @overload
    def register(self, name: str) -> Callable[[D], D]: ...
    @overload
    def register(self, name: str, target: T | str) -> T | str: ...
    def register(self, name: str, target: Any = None) -> Any:
        """Register ``target``, or what is decorated, and return it. A name that is registered again is replaced."""
        if target is None:
            return lambda decorated: self.register(name, decorated)
        self._entries[name] = target
        return target

    def check(self, name: str) -> None:
        """Raise :class:`InvalidInputError` unless ``name`` is registered; imports nothing."""
        if name not in self:
            known = ", ".join(map(repr, self._entries))
            raise InvalidInputError(f"{self.kind}: expected one of {known}, got {name!r}")

    def __getitem__(self, name: str) -> T:
        self.check(name)
        target = self._entries[name] = resolve(self._entries[name])
        return target

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)
