"""Fixtures of tests of commands that register many photographs, for a ``conftest.py``."""

import pytest

from curvireg_torch.pipeline import DEFAULT, PRESETS
from tests._support.small import SMALL


@pytest.fixture(scope="session")
def banks(tmp_path_factory):
    """A cache that the tests share."""
    return tmp_path_factory.mktemp("banks")


@pytest.fixture
def out(tmp_path):
    """The folder of the results, which does not exist yet."""
    return tmp_path / "out"


@pytest.fixture(autouse=True)
def _small(monkeypatch, banks):
    monkeypatch.setitem(PRESETS, DEFAULT, SMALL)
    monkeypatch.setenv("CURVIREG_CACHE", str(banks))
