"""Modules of other packages, loaded when they are first used."""

import importlib
import importlib.util
import sys
from types import ModuleType
from typing import Any


class _Postponed(ModuleType):
    """Stands for a module until an attribute of it is used."""

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            sys.modules.pop(self.__name__, None)
        module = importlib.import_module(self.__name__)
        return getattr(module, name)


def postpone_imports(*names: str) -> None:
    """Load modules when an attribute of them is first used, whoever imports them; those that are
    loaded already, or not installed, are left alone.

    Example:
        >>> postpone_imports("colorsys")
        >>> import colorsys
        >>> colorsys.rgb_to_hsv(1.0, 1.0, 1.0)
        (0.0, 0.0, 1.0)
    """
    for name in names:
        spec = None if name in sys.modules else importlib.util.find_spec(name)
        if spec is not None:
            module = _Postponed(name)
            module.__file__ = spec.origin  # torch asks all modules where they are
            sys.modules[name] = module
