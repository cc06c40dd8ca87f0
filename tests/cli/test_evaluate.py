"""``curvireg evaluate``."""

import json
from dataclasses import replace

import pytest

from curvireg_torch.cli import parse
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.pipeline import DEFAULT, PRESETS
from tests.evaluation.small import SMALL


@pytest.fixture(autouse=True)
def _small_pipeline(monkeypatch, tmp_path):
    monkeypatch.setitem(PRESETS, DEFAULT, SMALL)
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def evaluate(tmp_path):
    """Run ``curvireg evaluate``; returns the summary."""

    def run(*words):
        arguments = parse(["evaluate", *map(str, words), "--out", str(tmp_path / "out"), "--quiet"])
        arguments.run(arguments)
        return json.loads((tmp_path / "out" / "summary.json").read_text())

    return run


def test_evaluate_pascal3d(pascal, evaluate, capsys):
    words = ("pascal3d", pascal.root, "--categories", "car")
    assert evaluate(*words, "--limit", "2")["limit"] == 2
    summary = evaluate(*words)
    assert list(summary["per_class"]) == ["car"]
    assert (summary["n"], summary["protocol"]) == (3, "cad=annotated pose=upright box=annotated")
    lines = capsys.readouterr().out.splitlines()
    assert lines[-3].startswith("3 objects, 0 failed, ")
    numbers = f"acc_pi_6 {summary['acc_pi_6']:.3f}   acc_pi_18 {summary['acc_pi_18']:.3f}   "
    assert lines[-2].startswith(numbers)


def test_evaluate_bop_assumes_any_pose(bop, evaluate):
    summary = evaluate("bop", bop.root, "--protocol", "box=0.1", "seed=3")
    assert summary["protocol"] == "cad=annotated pose=any box=0.1 seed=3"
    assert summary["settings"]["dataset"] == "bop"
    views = summary["settings"]["pipeline"]["views"]
    assert (views["pose"], views["directions"], views["theta_step"]) == ("any", 18, 360.0)


def test_evaluate_without_boxes_reports_detection(pascal, evaluate, tmp_path, capsys, monkeypatch):
    """The summary has the recall of boxes; thumbnails show the found box."""
    boxes = []
    monkeypatch.setattr("curvireg_torch.evaluation.runner.thumbnail", lambda *a: boxes.append(a[3]) or b"")
    words = ("pascal3d", pascal.root, "--limit", "2", "--protocol", "box=none")
    summary = evaluate(*words)
    assert summary["detection"]["n"] == 2
    assert f"recall_1 {summary['detection']['recall_1']:.3f}   recall_5" in capsys.readouterr().out
    rows = [json.loads(line) for line in (tmp_path / "out" / "results.jsonl").read_text().splitlines()]
    row = next(row for row in rows if "detection" in row)
    assert row["detection"]["proposals"][0]["box"] in boxes


def test_evaluate_reports_when_nothing_was_scored(pascal, evaluate, tmp_path):
    for photograph in (pascal.root / "Images").rglob("*.jpg"):
        photograph.write_bytes(b"")
    with pytest.raises(InvalidInputError, match=r"nothing was scored .*unreadable_image"):
        evaluate("pascal3d", pascal.root)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["n"] == 0


def test_evaluate_takes_a_pipeline_file(pascal, evaluate, tmp_path):
    (tmp_path / "pipeline.json").write_text(replace(SMALL, box_jitter=0.0).to_json())
    settings = evaluate("pascal3d", pascal.root, "--pipeline", tmp_path / "pipeline.json")["settings"]
    assert (settings["preset"], settings["pipeline"]["box_jitter"]) == ("custom", 0.0)
