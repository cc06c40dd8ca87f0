"""Public names. Which module may import which is checked by import-linter (``pyproject.toml``)."""

import curvireg_torch


def test_public_names_are_sorted_and_documented():
    names = curvireg_torch.__all__
    assert names == sorted(names, key=lambda n: (not n.isupper(), n[0].islower(), n))
    for name in names:
        assert getattr(curvireg_torch, name).__doc__, name
