"""scripts/calibration/hints.py: sets that are measured again replace their lines."""

import json
import sys

from scripts.calibration import hints


def test_forms_without_photographs_get_no_line():
    rows = {hint: {0: {"form": "exact", "kind": None, "like": "a", "errors": [3.0]}} for hint in ("none", "azimuth:45")}
    assert list(hints.benchmark_rates(rows)) == ["benchmark, exact, upright"]


def test_sets_that_are_not_measured_again_keep_their_lines(tmp_path, monkeypatch):
    old = {name: {"n": 9, "none": [0.5], "azimuth:90": [0.6], "commit": "old"} for name in ("lm", "hope")}
    record, page = tmp_path / "hints.json", tmp_path / "docs" / "guides" / "pose-prior.md"
    record.write_text(json.dumps({"date": "", "commit": "old", "sets": old}))
    page.parent.mkdir(parents=True)
    page.write_text("<!-- hints:begin -->\n<!-- hints:end -->\n")
    for hint, share in (("none", 0.625), ("azimuth:45", 0.75)):
        out = tmp_path / "runs" / hint / "lm"
        out.mkdir(parents=True)
        (out / "summary.json").write_text(json.dumps({"n": 8, "acc_30_deg": share}))
    monkeypatch.setattr(hints, "RECORD", record)
    monkeypatch.setattr(hints, "REPOSITORY", tmp_path)
    monkeypatch.setattr(hints, "commit", lambda: "new")
    monkeypatch.setattr(sys, "argv", ["hints.py", str(tmp_path), str(tmp_path / "runs")])
    hints.main()
    found = json.loads(record.read_text())["sets"]
    assert found["hope"] == old["hope"]
    monkeypatch.setattr(hints, "commit", lambda: "newer")
    hints.main()  # the same runs: nothing was measured again
    assert json.loads(record.read_text())["sets"] == found
    assert found["lm"] == {"n": 8, "none": [0.625], "azimuth:45": [0.75], "commit": "new"}
    assert "| lm | 8 | 0.62 | - | 0.75 | - | new |" in page.read_text()
