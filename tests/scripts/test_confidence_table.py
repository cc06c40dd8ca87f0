import json
from copy import deepcopy

import pytest

from scripts._shared import REPOSITORY, RESULTS, read_json
from scripts.confidence_table import (
    GENERATED,
    generated_part,
    measured,
    merged,
    table,
    table_of_generated,
    table_of_withheld,
)
from tests._support import refused

PAGE = REPOSITORY / "docs" / "accuracy.md"
ROWS = """\
{"key": "a", "confidence": 0.95, "reliable": true, "ambiguous": null}
{"key": "b", "confidence": 0.97, "reliable": true, "ambiguous": "several"}
{"key": "c", "confidence": 0.31, "reliable": false, "ambiguous": "half turn"}
{"key": "d", "verdict": "failed"}
{"key": "e", "confidence": 0.99, "reliable": true, "ambiguous": null}
"""


def run(folder, column):
    folder.mkdir()
    summary = {"settings": {"dataset": "bop" if column == "rotation" else "pascal3d"}}
    (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    (folder / "results.jsonl").write_text(ROWS, encoding="utf-8")
    errors = f"key,group,{column}\na,1,29.9\nb,1,30.1\nc,2,3.0\nd,2,inf\ne,2,\n"
    (folder / "errors.csv").write_text(errors, encoding="utf-8")
    return folder


@pytest.mark.parametrize("column", ["rotation", "symmetric_error_deg"])
def test_confidences_are_counted(tmp_path, column):
    row = measured(run(tmp_path / "set", column))
    assert (row["n"], row["reliable"], row["reliable_right"], row["ambiguous"]) == (4, 2, 1, 2)
    assert row["mean_confidence"] == pytest.approx((0.95 + 0.97 + 0.31) / 4)
    assert row["right"] == 0.5
    assert row["auc"] == 0.5  # of the pairs of right and wrong: ab -, ad +, cb -, cd +
    assert "| `set` | 4 | 0.56 | 0.50 | 2 | 1 | 2 | 0.50 |" in table([row])
    (tmp_path / "set" / "errors.csv").write_text(f"key,group,{column}\na,1,\n", encoding="utf-8")
    with refused("no object whose true pose is known"):
        measured(tmp_path / "set")


def test_new_rows_replace_those_of_the_same_set():
    stored = [{"name": "a", "n": 1}, {"name": "b", "n": 2}]
    rows = merged(stored, [{"name": "c", "n": 3}, {"name": "a", "n": 4}])
    assert [(row["name"], row["n"]) for row in rows] == [("a", 4), ("b", 2), ("c", 3)]


def test_one_kind_of_answers_has_no_order(tmp_path):
    folder = run(tmp_path / "set", "rotation")
    (folder / "errors.csv").write_text("key,group,rotation\na,1,1.0\nc,2,3.0\n", encoding="utf-8")
    row = measured(folder)
    assert row["auc"] is None
    assert table([row]).splitlines()[-1].endswith("|  |")


def test_the_page_shows_the_confidences_of_the_calibration():
    record = read_json(RESULTS / "calibration.json")
    sets = record["held out"]["instance"]["sets"]
    assert set(GENERATED) == set(sets)
    assert generated_part(record) in PAGE.read_text("utf-8")
    quality = record["held out"]["instance"]
    sentence, lines, covered = generated_part(record).split("\n\n")
    assert sentence.startswith(f"Fitted on {quality['n']} generated photographs")
    assert lines == table_of_generated(sets).strip()
    assert covered.startswith(f"Of {quality['covariances']} right and reliable answers")
    half = deepcopy(record)
    half["constants"]["covariance_scale"] = 2.0 * quality["covariance_scale"]
    assert "with 0.50 times the variance, 0.90 would." in generated_part(half)
    few = {"n": 7, "said": 0.126, "right": 0.0, "reliable": 0.5, "reliable and wrong": 3}
    changed = sets | {"wrong": few | {"auc": None}}
    assert "| another mesh | 7 | 0.13 | 0.00 | 0.50 | 3 |  |" in table_of_generated(changed)


def test_photographs_with_and_without_cameras_stand_side_by_side():
    record = read_json(RESULTS / "calibration.json")
    sets = record["held out"]["instance"]["sets"]
    assert table_of_withheld(sets) in PAGE.read_text("utf-8")
    given = {"n": 3, "within 5": 0.25, "within 15": 0.75, "median": 4.04}
    none = {"n": 3, "within 5": 0.125, "within 15": 0.5, "median": 9.96}
    changed = sets | {"packages": given, "estimated_packages": none}
    last = table_of_withheld(changed).splitlines()[-1]
    assert last == "| packages | 3 | 0.25, 0.12 | 0.75, 0.50 | 4.0°, 10.0° |"
