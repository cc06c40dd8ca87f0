"""The scripts behind docs/accuracy.md."""

import sys
from pathlib import Path

import pytest
import torch

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    import ablate
    import error_taxonomy

    yield ablate, error_taxonomy
    for name in ("ablate", "error_taxonomy", "results_table"):
        sys.modules.pop(name, None)


def test_interval_is_that_of_a_share(scripts):
    """Against the normal approximation of a binomial share."""
    ablate, _ = scripts
    values = (torch.arange(400) % 4 == 0).float()
    mean, low, high = ablate.interval(values)
    assert mean == 0.25
    half = 1.96 * (0.25 * 0.75 / 400) ** 0.5
    assert low == pytest.approx(mean - half, abs=0.006)
    assert high == pytest.approx(mean + half, abs=0.006)


def test_paired_differences_are_sharper_than_their_parts(scripts):
    ablate, _ = scripts
    one = (torch.arange(100) % 2).float()
    better = one.clone()
    better[::20] = 1.0
    mean, low, high = ablate.interval(better - one)
    assert mean == pytest.approx(0.05)
    assert low >= 0.0
    assert high <= 0.1


def test_table_has_a_line_for_every_row_that_was_measured(scripts):
    ablate, _ = scripts
    kept = {"errors": [5.0, 20.0, 50.0, 10.0], "whole": [True, True, False, False]}
    worse = {**kept, "errors": [5.0, 80.0, 50.0, 10.0]}
    text = ablate.table({"learned": {"lm": kept}, "classical": {"lm": worse}})
    lines = text.splitlines()
    assert lines[0] == "**lm**"
    assert lines[4].startswith("| learned | 4 | 0.750 (")
    assert "| 0.500 | 10.0° | 1.000 (2) |" in lines[4]
    assert lines[5].startswith("| classical | 4 | 0.500 (")
    assert "-0.250 (" in lines[5]


@pytest.mark.parametrize(
    ("azimuth", "elevation_error", "kind"),
    [
        (42.0, 12.0, "right"),
        (215.0, 170.0, "half a turn"),
        (-35.0, 75.0, "mirrored"),
        (50.0, 40.0, "elevation or in-plane angle"),
        (130.0, 90.0, "other"),
        ("", float("inf"), "other"),
    ],
)
def test_kinds_of_errors(scripts, azimuth, elevation_error, kind):
    _, taxonomy = scripts
    row = {"azimuth": str(azimuth), "true_azimuth": "40", "symmetric_error_deg": str(elevation_error)}
    assert taxonomy.kind(row) == kind
