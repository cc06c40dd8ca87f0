"""Programs of ``scripts/`` as modules."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import pytest

__all__ = ["ROOT", "SCRIPTS", "imported"]

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"


@contextmanager
def imported(name: str) -> Iterator[ModuleType]:
    """The module; afterwards neither it nor what it imported from beside it is known any more."""
    before = set(sys.modules)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        try:
            yield importlib.import_module(name)
        finally:
            for other in set(sys.modules) - before:
                if other.startswith("scripts."):
                    del sys.modules[other]
