import pytest

from curvireg_torch.pipeline import DEFAULT, PRESETS
from tests._support.small import SMALL


@pytest.fixture(autouse=True)
def _small(monkeypatch, tmp_path):
    monkeypatch.setitem(PRESETS, DEFAULT, SMALL)
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
