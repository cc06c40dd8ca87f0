"""``scripts/speed/location.py``: what it makes of its rows, and that its table stands in the guide."""

import json

import pytest

from tests._support.scripts import ROOT, imported


@pytest.fixture
def script():
    for name in ("sklearn", "matplotlib"):
        pytest.importorskip(name, reason=f"{name} is not installed")
    with imported("scripts.speed.location") as script:
        yield script


def row(number, *, right, preset="learned", linemod=False):
    """The place ``right`` of three overlaps; it scores higher, and those of the photograph without it lower."""
    overlaps = [0.6 if k == right else 0.1 for k in range(3)]
    evidence = [[9.0 if k == right else 6.0 + 0.01 * number, 0.7] for k in range(3)]
    absent = {"overlaps": [0.0] * 3, "evidence": [[5.0 + 0.1 * (number % 7), 0.6]] * 3}
    one = {"id": number, "pose": "upright", "form": "exact", "mesh": f"m{number}", "preset": preset}
    peer = {"linemod": {"overlaps": [0.1, 0.55, 0.0]}} if linemod else {}
    return {**one, "present": {"overlaps": overlaps, "evidence": evidence}, "absent": absent, **peer}


def test_the_record_counts_what_its_rows_say(script):
    rows = [row(k, right=k % 2, linemod=k < 4) for k in range(12)] + [row(20, right=2, preset="fast")]
    record, drawn = script.record_of(rows)
    learned, fast = record["sets"]
    assert (learned["set"], learned["preset"], learned["n"]) == ("exact upright", "learned", 12)
    assert [learned[f"recall_{k}"] for k in (1, 5, 20)] == [0.5, 1.0, 1.0]
    assert learned["surest"] == 1.0, "the right place scores higher, whichever it is"
    assert (learned["linemod_n"], learned["linemod"]["recall_1"], learned["linemod"]["recall_5"]) == (4, 0.0, 1.0)
    assert (fast["n"], fast["recall_1"], fast["recall_5"], fast["linemod"]) == (1, 0.0, 1.0, None)
    told = record["presence"]["learned"]
    assert set(record["presence"]) == {"learned"}, "the others are not fitted"
    assert told["weights"][0] > 0
    assert told["forms"]["exact"]["photographs"] == {"n": 24, "true": 12, "auc": 1.0}
    assert told["forms"]["exact"]["places"] == {"n": 72, "true": 12, "auc": 1.0}
    assert [len(axes.lines) for axes in script.draw(drawn).axes] == [2, 2], "a curve and the diagonal"


def test_the_guide_has_the_table_of_the_record(script):
    record = json.loads((ROOT / "scripts" / "results" / "location.json").read_text(encoding="utf-8"))
    page = (ROOT / "docs" / "guides" / "without-a-box.md").read_text(encoding="utf-8")
    assert f"<!-- location:begin -->\n{script.table(record)}<!-- location:end -->" in page
    record["sets"][0]["recall_1"] += 0.01
    assert script.table(record) not in page
