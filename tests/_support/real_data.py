"""Where the cases of users lie, and the real photographs, if this checkout has them beside it."""

import os
from pathlib import Path

import pytest


def real_data(name):
    """The folder ``name`` of the shared data; skips the test where it is absent."""
    given = os.environ.get("CURVIREG_SHARED_DATA")
    root = Path(given or Path(__file__).parents[3] / "shared" / "data")
    if not (root / name).is_dir():
        pytest.skip(
            f"no real photographs: {name} is neither in $CURVIREG_SHARED_DATA nor in ../shared/data"
        )
    return root / name


def real_case(name):
    """The folder ``name`` of the cases that users reported, in tests/data/cases."""
    folder = Path(__file__).parents[1] / "data" / "cases" / name
    assert folder.is_dir(), f"no case {name}"
    return folder
