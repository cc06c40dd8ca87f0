"""A web collection whose poses are partly known, and the table of all kinds of datasets."""

import csv

import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import DATASETS, Protocol, WebBenchmark
from tests._support.miniature import write_bop, write_pascal3d, write_web

from ..cli.test_evaluate import evaluate


def test_a_collection_is_evaluated(web, tmp_path, capsys):
    evaluate("web", web.root, "--out", tmp_path / "out")
    out = capsys.readouterr().out
    assert "4 objects, 0 failed" in out
    assert "the true pose of 2 is known: their scores are\nacc_15_deg" in out
    with open(tmp_path / "out" / "predictions.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["category"] for line in lines] == ["cup"] * 3 + ["shoe"]
    assert [line["true_azimuth"] for line in lines] == ["30", "", "90", ""]
    assert [bool(line["error_deg"]) for line in lines] == [True, False, True, False]
    assert all(line["azimuth"] and line["confidence"] for line in lines)
    assert "pose=any" in out


def test_scores_are_of_known_poses_alone(web):
    benchmark = WebBenchmark(web, Protocol(pose="any"))
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    rows = [{"rotation": web.annotation(0)["rotation"].tolist(), "confidence": 0.75, "reliable": True}]
    rows += [{"rotation": half_turn.tolist(), "confidence": 0.25, "reliable": False}]
    rows += [{"rotation": (web.annotation(2)["rotation"] @ half_turn).tolist(), "confidence": 0.5, "reliable": False}]
    rows += [{"failed": "flat"}]
    errors = benchmark.rotation_errors(benchmark.items, rows)
    assert errors[[0, 2]].tolist() == pytest.approx([0, 180], abs=0.1)
    assert errors.isnan().tolist() == [False, True, False, True]
    summary = benchmark.summary(benchmark.items, rows)
    assert (summary["n"], summary["n_posed"], summary["reliable"]) == (4, 2, 1)
    assert (summary["acc_30_deg"], summary["mean_confidence"]) == (0.5, 0.375)
    assert summary["per_object"]["cup"]["mean_confidence"] == 0.5
    assert summary["per_object"]["shoe"] == {
        "n": 1, "n_posed": 0, "reliable": 0, "mean_confidence": 0.0,
        "acc_15_deg": None, "acc_30_deg": None, "med_err_deg": None,
    }  # fmt: skip
    missed = benchmark.rotation_errors(benchmark.items[:1], [{"failed": "flat"}])
    assert missed.tolist() == [torch.inf]


def test_no_pose_is_known(web, tmp_path, capsys):
    for name in ("no_mesh", "no_table", "other_table", "cup"):
        for path in (web.root / name).iterdir():
            path.unlink()
    evaluate("web", web.root, "--out", tmp_path / "out")
    out = capsys.readouterr().out
    assert "the true pose of 0 is known: nothing to compare" in out
    assert "acc_" not in out


def test_another_cad_is_refused(web, tmp_path):
    with pytest.raises(InvalidInputError, match="cad=annotated; got cad=any"):
        evaluate("web", web.root, "--out", tmp_path / "out", "--protocol", "cad=any")


@pytest.mark.parametrize("kind", DATASETS)
def test_every_kind_opens_and_names_its_groups(kind, tmp_path):
    {"pascal3d": write_pascal3d, "bop": write_bop, "web": write_web}[kind](tmp_path)
    row = DATASETS[kind]
    dataset = row.open(tmp_path, **row.whole)
    sample = dataset.annotation(0)
    assert row.category.format_map(sample) in ("car", "object 1", "cup")
    assert row.mesh in sample
    benchmark = row.scored(dataset, Protocol(pose=row.pose))
    assert benchmark.name == kind
    assert [str(path) for path in benchmark.items[0].meshes] == [str(sample[row.mesh])]
