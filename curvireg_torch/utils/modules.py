"""Modules that other packages import and seldom use, loaded when they are used."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from types import ModuleType
from typing import Any


class _Postponed(ModuleType):
    """Stands for a module in packages that were imported while it was postponed."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self:  # from module import name
            return _PostponedName(self, name)
        return getattr(importlib.import_module(self.__name__), name)


class _PostponedName:
    """Stands for a function or class of a postponed module, which is loaded by a call."""

    def __init__(self, module: _Postponed, name: str) -> None:
        self._module = module
        self._name = name

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        _withdraw(self._module)
        return getattr(self._module, self._name)(*arguments, **named)


@contextmanager
def postponed_imports(*names: str) -> Iterator[None]:
    """Context in which packages get stand-ins for modules that they import: a module is loaded when
    an attribute of it is used afterwards, or when a function is called that was imported from it.
    Packages that are imported later get the module itself.

    Modules that are loaded already, or not installed, are left alone.

    Example:
        >>> with postponed_imports("colorsys"):
        ...     import colorsys
        >>> colorsys.rgb_to_hsv(1.0, 1.0, 1.0)
        (0.0, 0.0, 1.0)
    """
    modules = [_Postponed(name) for name in names if name not in sys.modules and _is_there(name)]
    for module in modules:
        package, _, last = module.__name__.rpartition(".")
        sys.modules[module.__name__] = module
        if package in sys.modules:
            setattr(sys.modules[package], last, module)
    try:
        yield
    finally:
        for module in modules:
            _withdraw(module)


def _withdraw(module: _Postponed) -> None:
    """From now on, an import loads the module that this one stands for."""
    package, _, last = module.__name__.rpartition(".")
    if sys.modules.get(module.__name__) is module:
        del sys.modules[module.__name__]
    parent = sys.modules.get(package)
    if parent is not None and vars(parent).get(last) is module:
        delattr(parent, last)


def _is_there(name: str) -> bool:
    """Whether the package of a module is installed; it is not imported."""
    return find_spec(name.partition(".")[0]) is not None
