"""``curvireg evaluate`` as the command line holds it."""

import json
from dataclasses import replace

import pytest

from curvireg_torch.cli import parse
from curvireg_torch.errors import InvalidInputError, MissingFileError
from curvireg_torch.evaluation import contact_sheet
from curvireg_torch.evaluation.localization import localization_recall
from curvireg_torch.pipeline import DEFAULT, PRESETS
from tests.evaluation.small import SMALL


@pytest.fixture(autouse=True)
def _small_pipeline(monkeypatch, tmp_path):
    monkeypatch.setitem(PRESETS, DEFAULT, SMALL)
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))


def evaluate(*words):
    arguments = parse(["evaluate", *map(str, words), "--quiet"])
    arguments.run(arguments)


def test_pascal3d(pascal, tmp_path, capsys):
    words = ("pascal3d", pascal.root, "--categories", "car", "--out", tmp_path / "out")
    evaluate(*words, "--limit", "2")
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["limit"] == 2
    evaluate(*words)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert list(summary["per_class"]) == ["car"]
    assert (summary["n"], summary["protocol"]) == (3, "cad=annotated pose=upright box=annotated")
    lines = capsys.readouterr().out.splitlines()
    assert lines[-3].startswith("3 objects, 0 failed, ")
    assert lines[-2].split()[:4] == [
        "acc_pi_6", f"{summary['acc_pi_6']:.3f}", "acc_pi_18", f"{summary['acc_pi_18']:.3f}",
    ]  # fmt: skip


def test_bop_supposes_any_orientation(bop, tmp_path):
    evaluate("bop", bop.root, "--out", tmp_path / "out", "--protocol", "box=0.1", "seed=3")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["protocol"] == "cad=annotated pose=any box=0.1 seed=3"
    assert summary["settings"]["dataset"] == "bop"
    views = summary["settings"]["pipeline"]["views"]
    assert (views["pose"], views["directions"], views["theta_step"]) == ("any", 18, 360.0)


def test_without_boxes(pascal, tmp_path, capsys, monkeypatch):
    """The summary has the recall of boxes, or says that no box is annotated."""
    evaluate("pascal3d", pascal.root, "--limit", "2", "--out", tmp_path / "out", "--protocol", "box=none")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["localization"]["n"] == 2
    assert f"recall_1 {summary['localization']['recall_1']:.3f}   recall_5" in capsys.readouterr().out
    contact_sheet(tmp_path / "out", tmp_path / "sheet.html")
    row = next(row for row in rows_of(tmp_path / "out") if "localization" in row)
    seen = []
    monkeypatch.setattr("curvireg_torch.evaluation.sheet.thumbnail", lambda *a: seen.append(a[3]) or b"")
    contact_sheet(tmp_path / "out", tmp_path / "sheet.html")
    assert row["localization"]["proposals"][0]["box"] in seen, "the page shows the box that was found"
    summary["localization"] = localization_recall([], [])
    monkeypatch.setattr("curvireg_torch.evaluation.datasets.evaluate", lambda *_, **__: summary)
    evaluate("pascal3d", pascal.root, "--limit", "2", "--out", tmp_path / "out", "--protocol", "box=none")
    assert "no box is annotated" in capsys.readouterr().out


def rows_of(folder):
    return [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]


def test_errors_come_before_any_work(pascal, bop, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(MissingFileError, match="no such folder"):
        evaluate("pascal3d", tmp_path / "nowhere", "--out", out)
    with pytest.raises(InvalidInputError, match="cad: expected one of"):
        evaluate("pascal3d", pascal.root, "--out", out, "--protocol", "cad=all")
    with pytest.raises(InvalidInputError, match="has one mesh, so cad=annotated"):
        evaluate("bop", bop.root, "--out", out, "--protocol", "cad=any")
    with pytest.raises(SystemExit):
        evaluate("bop", bop.root, "--out", out, "--preset", "best")
    assert not out.exists()


def test_nothing_scored_is_an_error(pascal, tmp_path):
    for photograph in (pascal.root / "Images").rglob("*.jpg"):
        photograph.write_bytes(b"")
    with pytest.raises(InvalidInputError, match=r"nothing was scored .*unreadable_image"):
        evaluate("pascal3d", pascal.root, "--out", tmp_path / "out")
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["n"] == 0


def test_a_pipeline_of_ones_own(pascal, tmp_path):
    (tmp_path / "own.json").write_text(replace(SMALL, box_jitter=0.0).to_json())
    evaluate("pascal3d", pascal.root, "--out", tmp_path / "out", "--pipeline", tmp_path / "own.json")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["settings"]["preset"], summary["settings"]["pipeline"]["box_jitter"]) == ("own", 0.0)
