"""The public names of the package. Who may import whom is a contract of import-linter in ``pyproject.toml``."""

import curvireg_torch


def test_public_names_are_documented():
    assert "Registrar" in curvireg_torch.__all__

    for name in curvireg_torch.__all__:
        assert getattr(curvireg_torch, name).__doc__, name
