"""Public names. Which module may import which is checked by import-linter (``pyproject.toml``)."""

import curvireg_torch


def test_public_names_are_documented():
    assert "Registrar" in curvireg_torch.__all__
    for name in curvireg_torch.__all__:
        assert getattr(curvireg_torch, name).__doc__, name
