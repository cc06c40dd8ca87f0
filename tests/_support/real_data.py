"""Where the real photographs lie, if this checkout has them beside it."""

import os
from pathlib import Path

import pytest


def real_data(name: str) -> Path:
    """The folder ``name`` of the shared data; skips the test where it is absent."""
    root = Path(
        os.environ.get("CURVIREG_SHARED_DATA") or Path(__file__).parents[3] / "shared" / "data"
    )
    if not (root / name).is_dir():
        pytest.skip(
            f"no real photographs: {name} is neither in $CURVIREG_SHARED_DATA nor in ../shared/data"
        )
    return root / name
