"""Scores from predictions that are made up, so that every number is known beforehand."""

import csv
import json

import pytest
import torch
import trimesh

from curvireg_torch.data import Pascal3DPlus, read_bop_csv
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol, score
from curvireg_torch.evaluation.store import ResultStore
from curvireg_torch.geometry import rotation_from_viewpoint
from tests._support.miniature import pascal_object, write_image, write_mesh, write_record

SECONDS = {"bank": 2.0, "register": 0.5}


def turned(sample, axis, degrees):
    """The true rotation after a turn of the model about x or z."""
    turn = torch.linalg.matrix_exp(
        torch.deg2rad(torch.tensor(float(degrees), dtype=torch.float64))
        * torch.linalg.cross(torch.eye(3).double(), torch.eye(3).double()["xyz".index(axis)].expand(3, 3)).T
    )
    return (sample["rotation"].double() @ turn).tolist()


def write_predictions(benchmark, out, rows):
    store = ResultStore(out)
    store.open({"root": "/some/where", "protocol": str(benchmark.protocol)})
    for item, row in zip(benchmark.items, rows, strict=True):
        full = {"score": 0.5, "confidence": 0.5, "mesh": "01.off", "image_size": [60, 80], "seconds": SECONDS}
        store.append({"key": item.key, "digests": {}, **(row if "skipped" in row else full | row)})


@pytest.fixture
def furniture(tmp_path):
    """Four bottles, a table and four sofas, with flags."""
    root = tmp_path / "pascal"
    flags = [{}, {"truncated": 1}, {"occluded": 1}, {"difficult": 1, "truncated": 1}]
    objects = {
        "bottle": [pascal_object("bottle", **f) for f in flags],
        "diningtable": [pascal_object("diningtable")],
        "sofa": [pascal_object("sofa", **f) for f in flags],
    }
    for name, entries in objects.items():
        write_record(root / "Annotations" / f"{name}_pascal" / "1.mat", entries)
        write_image(root / "Images" / f"{name}_pascal" / "1.jpg")
        write_mesh(root / "CAD" / name / "01.off")
        root.joinpath("Image_sets").mkdir(exist_ok=True)
        root.joinpath("Image_sets", f"{name}_pascal_val.txt").write_text("1\n")
    return Pascal3DBenchmark(Pascal3DPlus(root), Protocol())


def test_pascal3d_summary(furniture, tmp_path):
    samples = [furniture.dataset.annotation(i) for i in range(9)]
    turns = [("z", 90), ("z", 40), ("x", 20), None, ("z", 180), ("z", 5), ("z", 20), ("z", 180), "skip"]
    rows = [
        {"failed": "one colour"}
        if turn is None
        else {"skipped": "unreadable_image"}
        if turn == "skip"
        else {"rotation": turned(sample, *turn)}
        for sample, turn in zip(samples, turns, strict=True)
    ]
    write_predictions(furniture, tmp_path / "out", rows)
    summary = score(furniture, tmp_path / "out")
    assert summary == json.loads((tmp_path / "out" / "summary.json").read_text()) | {
        "subsets": summary["subsets"], "symmetry_aware": summary["symmetry_aware"], "per_class": summary["per_class"],
    }  # fmt: skip
    # errors: bottles 90, 40, 20, miss; table 180; sofas 5, 20, 180
    assert (summary["n"], summary["failed"], summary["skipped"]) == (8, 1, {"unreadable_image": 1})
    assert summary["acc_pi_6"] == 3 / 8
    assert summary["acc_pi_18"] == 1 / 8
    assert summary["med_err_deg"] == pytest.approx(65, abs=1e-3)
    # with symmetries: bottles 0, 0, 20, miss; table 0
    assert summary["symmetry_aware"]["acc_pi_6"] == 6 / 8
    assert summary["symmetry_aware"]["acc_pi_18"] == 4 / 8
    assert summary["symmetry_aware"]["med_err_deg"] == pytest.approx(12.5, abs=1e-3)
    assert {name: s["n"] for name, s in summary["subsets"].items()} == {
        "easy": 3, "truncated": 3, "occluded": 2, "difficult": 1,
    }  # fmt: skip
    assert summary["subsets"]["easy"]["acc_pi_6"] == 1 / 3
    assert summary["subsets"]["difficult"]["med_err_deg"] == float("inf")
    assert {name: s["n"] for name, s in summary["per_class"].items()} == {"bottle": 4, "diningtable": 1, "sofa": 3}
    assert summary["per_class"]["sofa"]["acc_pi_6"] == 2 / 3
    # 180 / sqrt 2 and more are still misses, 40 / sqrt 2 is not
    assert summary["legacy_sqrt2"]["acc_pi_6"] == 4 / 8
    # bins of 15 degrees about 30: the turn of 5 stays inside, and that about x, which moves the azimuth by 3.5 at most
    assert summary["azimuth_bin_accuracy"]["24"] == 2 / 8
    assert summary["seconds"] == {"bank": 16.0, "register": 4.0, "register_each": 0.5}
    assert "where" in summary["settings"]["root"]
    assert "some" not in summary["settings"]["root"], "a summary is shared: no paths"


def test_pascal3d_table(furniture, tmp_path):
    samples = [furniture.dataset.annotation(i) for i in range(9)]
    R = rotation_from_viewpoint(*torch.tensor([200.0, 10, -5]).double()).tolist()
    write_predictions(furniture, tmp_path / "out", [{"rotation": R}, {"failed": "?"}] + [{"skipped": "x"}] * 7)
    score(furniture, tmp_path / "out")
    with open(tmp_path / "out" / "predictions.csv", newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["category"], first["image_id"], first["truncated"]) == ("bottle", "1", "0")
    assert [float(first[k]) for k in ("azimuth", "elevation", "theta")] == pytest.approx([200, 10, -5], abs=1e-3)
    assert [float(first["true_" + k]) for k in ("azimuth", "elevation", "theta")] == samples[0]["viewpoint"].tolist()
    assert float(first["symmetric_error_deg"]) == pytest.approx(0, abs=1e-3)
    assert 150 < float(first["error_deg"]) <= 170
    assert first["seconds"] == "0.5", "of the registration, without the bank"
    assert (second["failed"], second["azimuth"], second["error_deg"]) == ("?", "", "inf")


def test_bop_summary(bop, tmp_path):
    benchmark = BOPBenchmark(bop, Protocol(pose="any"))
    samples = [bop.annotation(i) for i in range(len(bop))]
    assert [item.key for item in benchmark.items] == ["1/0/0", "1/0/1", "1/0/2", "2/7/0"]
    assert [s["obj_id"] for s in samples] == [1, 2, 1, 1]

    def row(i, degrees, shift):
        t = (samples[i]["translation"] + torch.tensor(shift)).tolist()
        return {"rotation": turned(samples[i], "z", degrees), "translation": t}

    diameter = 86.6
    rows = [
        row(0, 180, [0.0, 0, 0]),  # object 1 looks the same
        row(1, 180, [0.0, 0, 0]),  # object 2 does not
        {"failed": "one colour"},
        row(3, 20, [0.0, 0.04 * diameter, 0]),  # along the object's z
    ]
    write_predictions(benchmark, tmp_path / "out", rows)
    summary = score(benchmark, tmp_path / "out")
    assert (summary["n"], summary["failed"]) == (4, 1)
    # errors 0, 180, miss, 20
    assert summary["acc_15_deg"] == 1 / 4
    assert summary["acc_30_deg"] == 2 / 4
    assert summary["med_err_deg"] == pytest.approx(100, abs=1e-3)
    assert summary["per_object"]["2"]["acc_30_deg"] == 0
    assert summary["per_object"]["1"]["n"] == 3
    # MSSD in diameters: 0, then twice 35.4 / 86.6, miss, then hypot(2 * 35.4 sin 10 deg / 86.6, 0.04) = 0.147
    assert summary["mssd_ar"] == pytest.approx((1.0 + 0.0 + 0.0 + 0.8) / 4)
    # ADD(-S): 0, 0.816, miss, 0.147
    assert summary["add_recall_0.1d"] == 1 / 4
    # MSPD: 0, about 100 px, miss, about 9 px of 80, where thresholds are 5 / 8, ..., 50 / 8 px
    assert summary["mspd_ar"] == pytest.approx(1 / 4)
    assert summary["subsets"]["unoccluded"]["n"] == 0


def test_bop_table(bop, tmp_path):
    benchmark = BOPBenchmark(bop, Protocol(pose="any"))
    samples = [bop.annotation(i) for i in range(len(bop))]
    rows = [{"rotation": s["rotation"].tolist(), "translation": s["translation"].tolist()} for s in samples]
    rows[1] = {"failed": "?"}
    write_predictions(benchmark, tmp_path / "out", rows)
    score(benchmark, tmp_path / "out")
    table = read_bop_csv(tmp_path / "out" / "predictions.csv")
    assert [(r["scene_id"], r["im_id"], r["obj_id"]) for r in table] == [
        (s["scene_id"], s["image_id"], s["obj_id"]) for i, s in enumerate(samples) if i != 1
    ]
    assert [r["time"] for r in table] == [1.5, 1.5, 0.5], "BOP counts seconds of the whole image"


def test_bop_knows_the_object(bop):
    with pytest.raises(InvalidInputError, match="has one mesh, so cad=annotated"):
        BOPBenchmark(bop, Protocol(cad="any"))


@pytest.mark.parametrize("kind", ["pascal3d", "bop"])
def test_nothing_to_score(tmp_path, bop, furniture, kind):
    benchmark = BOPBenchmark(bop, Protocol(pose="any")) if kind == "bop" else furniture
    write_predictions(benchmark, tmp_path / "out", [{"skipped": "x"}] * len(benchmark.items))
    summary = score(benchmark, tmp_path / "out")
    assert (summary["n"], summary["skipped"]["x"]) == (0, len(benchmark.items))
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["med_err_deg"] is None


def test_missing_prediction_is_named(furniture, tmp_path):
    ResultStore(tmp_path / "out").open({"root": "x"})
    with pytest.raises(InvalidInputError, match=r"bottle.*run again"):
        score(furniture, tmp_path / "out")


def test_mspd_is_scaled_by_the_width_of_the_image(bop, tmp_path):
    """An error of 3 px at 80 px of width is one of 24 px at 640 px: below six of the thresholds 5, 10, ..., 50 px.
    By the height of 60 px it would be one of 32 px, below four."""
    benchmark = BOPBenchmark(bop, Protocol(pose="any"))
    samples = [bop.annotation(i) for i in range(len(bop))]
    rows = []
    for sample in samples:
        t = sample["translation"].double().clone()
        points = torch.from_numpy(trimesh.load(sample["model_path"]).vertices.copy()) @ sample["rotation"].double().T
        nearest = float((points[:, 2] + t[2]).min())
        t[0] += 3.0 * nearest / float(sample["camera_matrix"][0, 0])
        rows.append({"rotation": sample["rotation"].tolist(), "translation": t.tolist()})
    write_predictions(benchmark, tmp_path / "out", rows)
    assert score(benchmark, tmp_path / "out")["mspd_ar"] == pytest.approx(0.6)
