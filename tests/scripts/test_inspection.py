"""The tables that compare what ``curvireg inspect`` predicts with what is measured."""

import json

import pytest

from scripts.inspection import validate as module
from scripts.inspection.validate import (
    Rows,
    correlation,
    expected,
    generated_meshes,
    measured_real,
    pooled,
    real_objects,
    tables,
)


def shares(n, right, reliable):
    return {"n": n, "right": right, "reliable": reliable}


def test_rows_are_kept_unless_they_are_of_something_else(tmp_path):
    path = tmp_path / "work" / "rows.jsonl"
    measured = []

    def measure():
        measured.append(1)
        return {"predicted": [{"error": 3.0, "confidence": 0.95}]}

    assert Rows(path, [8]).get("a", measure)["predicted"][0]["error"] == 3.0
    Rows(path, [8]).get("a", measure)
    assert len(measured) == 1
    Rows(path, [9]).get("a", measure)
    Rows(path, [8]).get("b", measure)
    assert len(measured) == 3


def test_reliable_follows_the_present_constants(monkeypatch):
    rows = [
        {"error": 2.0, "features": {}, "scores": [1.0], "confidence": 0.1},
        {"error": 40.0, "confidence": 0.0},
    ]
    monkeypatch.setattr(module, "probability_of_any", lambda *_, **__: 0.95)
    assert expected(rows) == shares(2, 0.5, 0.5)
    monkeypatch.setattr(module, "probability_of_any", lambda *_, **__: 0.5)
    assert expected(rows) == shares(2, 0.5, 0.0)


def test_shares_of_meshes_are_weighted_by_their_photographs():
    both = pooled([(shares(8, 1.0, 0.5), 3), (shares(8, 0.0, 0.5), 1)])
    assert both == shares(16, 0.75, 0.5)


def test_correlation_and_what_is_too_rosy():
    found = correlation([0.2, 0.6, 1.0, 0.9], [0.1, 0.5, 0.9, 0.8])
    assert found["correlation"] == pytest.approx(1.0)
    assert found["too rosy by"] == pytest.approx(0.1)
    assert found["too rosy interval"] == pytest.approx([0.1, 0.1])
    assert correlation([1.0, 1.0], [0.0, 1.0])["correlation"] == 0.0


def test_real_rows_are_those_of_the_objects_that_were_predicted(tmp_path):
    (tmp_path / "models").mkdir()
    for k in (1, 2, 7):
        (tmp_path / "models" / f"obj_{k:06d}.ply").touch()
    per_object = {"1": {"n": 3, "acc_30_deg": 1.0}, "2": {"n": 1, "acc_30_deg": 0.0}}
    (tmp_path / "summary.json").write_text(json.dumps({"per_object": per_object}))
    rows = [
        {"mesh": f"models/obj_{k:06d}.ply", "reliable": reliable, "inputs": {"photo": "a.png"}}
        for k, reliable in ((1, True), (1, True), (1, False), (2, False))
    ]
    (tmp_path / "results.jsonl").write_text("\n".join(map(json.dumps, rows)) + "\n")
    assert real_objects(tmp_path, tmp_path) == {1: 3, 2: 1}
    assert measured_real(tmp_path, [1]) == {"n": 3, "right": 1.0, "reliable": pytest.approx(2 / 3)}
    assert measured_real(tmp_path, [1, 2])["right"] == 0.75


def test_tables_name_numbers_and_intervals():
    meshes = [
        {"name": "shapes 1", "kind": "shapes", **dict.fromkeys(module.CONDITIONS, shares(8, 1, 1))},
        {"name": "tied 1", "kind": "tied", **dict.fromkeys(module.CONDITIONS, shares(8, 0.5, 0))},
    ]
    summary = {"predicted: right": correlation([1.0, 0.5], [1.0, 0.5])}
    real = {"dino": {"objects": 1, "predicted": shares(8, 1, 1), "measured": shares(105, 1, 0.93)}}
    text = tables({"generated": {"summary": summary, "meshes": meshes}, "real": real})
    assert "| predicted: right | 2 | 1.00" in text
    assert "| tied | 1 | 0.50 (0.22 to 0.78; 8) |" in text
    assert "| dino | 1 | 1.00 (0.68 to 1.00; 8) | 1.00 (0.96 to 1.00; 105) |" in text


def test_generated_meshes_take_their_kinds_in_turn():
    names = [mesh.kind for mesh in generated_meshes(None)]
    assert names[:4] == ["shapes", "tied", "printed", "printed, grey"]
    assert len(names) == 21
    chosen = {mesh.name.split()[-1] for mesh in generated_meshes(None) if "printed" in mesh.kind}
    assert len(chosen) == 8, "those without print are others"
