"""``scripts/robustness/worst_cases.py``: it measures what it says, and its table stands in SECURITY.md."""

import json

import pytest

from tests._support.scripts import ROOT, imported


@pytest.fixture
def script():
    with imported("scripts.robustness.worst_cases") as script:
        yield script


def test_a_case_is_read_or_refused_in_our_words(script, monkeypatch, capsys, tmp_path):
    limit = script.limits.MAX_MAT_UNPACKED_BYTES
    for unpacked, outcome in ((50_000, "read"), (limit + 10_000, "refused: ")):
        monkeypatch.setattr(script.limits, "MAX_MAT_UNPACKED_BYTES", unpacked)
        script.CASES["mat"].make(tmp_path / "a.mat")
        script.worker("mat", tmp_path / "a.mat")
        found = json.loads(capsys.readouterr().out)
        assert found["outcome"].startswith(outcome)
        assert found["megabytes"] > 50
        assert found["seconds"] > 0


def test_too_long_too_much_and_dying_are_bad(script):
    found = {"outcome": "read", "seconds": 1.0, "megabytes": 500.0}
    assert script.within("mat", found)
    for change in ({"seconds": 1e4}, {"megabytes": 1e6}, {"outcome": "died: killed"}):
        assert not script.within("mat", {**found, **change})


def test_what_was_measured_is_within_what_security_states(script):
    kept = json.loads(script.RESULT.read_text())
    assert all(script.within(name, found) for name, found in kept.items())
    text = (ROOT / "SECURITY.md").read_text()
    assert script.replace_between(text, script.BEGIN, script.END, script.table(kept)) == text
