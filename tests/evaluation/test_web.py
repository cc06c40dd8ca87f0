import csv

import pytest
import torch

from curvireg_torch.cli import main
from curvireg_torch.evaluation import DATASETS, Protocol, WebBenchmark
from tests._support.miniature import write_bop, write_pascal3d, write_web


def evaluate(web, out, capsys):
    assert main(["evaluate", "web", str(web.root), "--out", str(out), "--quiet"]) == 0
    return capsys.readouterr().out


def test_web_collection_is_evaluated(web, tmp_path, capsys):
    out = evaluate(web, tmp_path, capsys)
    assert "4 objects, 0 failed" in out
    assert "the true pose of 2 is known: their scores are\nacc_15_deg" in out
    assert "pose=any" in out
    with open(tmp_path / "predictions.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["category"] for line in lines] == ["cup"] * 3 + ["shoe"]
    assert [line["true_azimuth"] for line in lines] == ["30", "", "90", ""]
    assert [bool(line["error_deg"]) for line in lines] == [True, False, True, False]
    assert all(line["azimuth"] for line in lines)


def test_web_summary_scores_known_poses(web):
    benchmark = WebBenchmark(web, Protocol(pose="any"))
    half = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    first, _, third, _ = (sample["rotation"] for sample in benchmark.samples(benchmark.items))
    poses = [(first, 0.75), (half, 0.25), (third @ half, 0.5)]
    rows = [{"rotation": R.tolist(), "confidence": c, "reliable": c > 0.7} for R, c in poses] + [{"failed": "flat"}]
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
    assert benchmark.rotation_errors(benchmark.items[:1], [{"failed": "flat"}]).tolist() == [torch.inf]


def test_web_collection_without_poses(web, tmp_path, capsys):
    for name in ("no_mesh", "no_table", "other_table", "cup"):
        for path in (web.root / name).iterdir():
            path.unlink()
    out = evaluate(web, tmp_path, capsys)
    assert "the true pose of 0 is known: nothing to compare" in out
    assert "acc_" not in out


@pytest.mark.parametrize("kind", DATASETS)
def test_every_dataset_opens_and_names_its_groups(kind, tmp_path):
    {"pascal3d": write_pascal3d, "bop": write_bop, "web": write_web}[kind](tmp_path)
    row = DATASETS[kind]
    dataset = row.open(tmp_path, **row.whole)
    sample = dataset.annotation(0)
    assert row.category.format_map(sample) in ("car", "object 1", "cup")
    benchmark = row.scored(dataset, Protocol(pose=row.pose))
    assert (benchmark.name, benchmark.mesh) == (kind, row.mesh)
    assert [str(path) for path in benchmark.items[0].meshes] == [str(sample[row.mesh])]
