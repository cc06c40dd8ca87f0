"""Packages whose names are imported when they are first asked for (PEP 562)."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy(package: str, places: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of ``package``.

    Args:
        package: its ``__name__``.
        places: names, divided by spaces, by the submodule that has them; the submodules can be asked for, too.
    """
    where = {name: place for place, names in places.items() for name in names.split()}

    def get(name: str) -> Any:
        if name not in where and name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        place = import_module("." + where.get(name, name), package)
        value = getattr(place, name) if name in where else place
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *where, *places})

    return get, names
