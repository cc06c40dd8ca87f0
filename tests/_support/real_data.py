"""Where the real photographs lie, if this checkout has them beside it."""

import os
from pathlib import Path

import pytest


def real_data(name: str) -> Path:
    """The folder ``name`` of the shared data; skips the test where it is absent."""
    root = _shared_data()
    if not (root / name).is_dir():
        pytest.skip(
            f"no real photographs: {name} is neither in $CURVIREG_SHARED_DATA nor in ../shared/data"
        )
    return root / name


def real_case(name: str) -> Path:
    """The folder ``name`` of the shared cases; skips the test where it is absent."""
    folder = _shared_data().parent / "cases" / name
    if not folder.is_dir():
        pytest.skip(f"no files of users: {name} is not in ../shared/cases")
    return folder


def _shared_data() -> Path:
    given = os.environ.get("CURVIREG_SHARED_DATA")
    return Path(given or Path(__file__).parents[3] / "shared" / "data")
