"""Evaluation of datasets, from files to files."""

import json
from dataclasses import replace

import cv2
import pytest
import torch

from curvireg_torch.data import read_bop_csv
from curvireg_torch.errors import InvalidInputError, RenderingError
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol, score
from curvireg_torch.evaluation.store import ResultStore
from curvireg_torch.filters import ImageGradient

from .helpers import rows_of, run, without_seconds


def test_evaluate_pascal3d(pascal, tmp_path):
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    summary = run(benchmark, tmp_path / "out")
    assert summary["n"] == 3
    assert {k: summary["skipped"][k] for k in ("unreadable_image", "unreadable_mesh")} == {
        "unreadable_image": 1, "unreadable_mesh": 1,
    }  # fmt: skip
    assert summary["skipped"]["missing_image"] == 1, "objects that the dataset leaves out are counted"
    assert "other_class" not in summary["skipped"], "objects of other classes are not"
    assert summary["failed"] == 0
    rows = rows_of(benchmark, tmp_path / "out")
    assert {k: r.get("skipped") for k, r in rows.items()} == {
        "car/2008_000001/0": None,
        "car/2008_000002/1": None,
        "car/2008_000002/2": None,
        "car/2008_000003/8": "unreadable_image",
        "sofa/2008_000002/0": "unreadable_mesh",
    }
    good = rows["car/2008_000001/0"]
    assert good["translation"] is None, "no camera was given"
    assert good["mesh"] == "01.off"
    assert good["seconds"]["register"] > 0
    R = torch.tensor(good["rotation"], dtype=torch.float64)
    torch.testing.assert_close(R @ R.T, torch.eye(3).double(), atol=1e-6, rtol=0)
    files = {p.name for p in (tmp_path / "out").iterdir()}
    assert files == {"results.jsonl", "settings.json", "predictions.csv", "summary.json"}
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["protocol"] == str(Protocol())


def test_evaluate_bop(bop, tmp_path):
    summary = run(BOPBenchmark(bop, Protocol(pose="any")), tmp_path / "out")
    assert (summary["n"], summary["failed"]) == (3, 0)
    assert summary["skipped"]["unknown_box"] == 1, "without scene_gt_info there is no box"
    detected = run(BOPBenchmark(bop, Protocol(pose="any", box=None)), tmp_path / "detected")
    assert "unknown_box" not in detected["skipped"]
    table = read_bop_csv(tmp_path / "out" / "predictions.csv")
    assert len(table) == 3
    assert all(row["t"][2] > 0 for row in table)


def test_objects_fail_alone(bop, tmp_path):
    benchmark = BOPBenchmark(bop, Protocol(pose="any"))
    first, second, third = benchmark.items[:3]
    oblong = first.camera_matrix.clone()
    oblong[0, 0] *= 1.3
    benchmark.items[0] = replace(first, camera_matrix=oblong)
    benchmark.items[1] = replace(second, box=second.box + 5000.0)
    summary = run(benchmark, tmp_path / "out")
    rows = rows_of(benchmark, tmp_path / "out")
    assert "square pixels" in rows[first.key]["failed"]
    assert "entirely outside" in rows[second.key]["failed"]
    assert "rotation" in rows[third.key]
    assert summary["failed"] == 2


def test_results_are_the_same_bits_on_other_threads_and_resumed(pascal, tmp_path):
    benchmark, before = Pascal3DBenchmark(pascal, Protocol()), torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        run(benchmark, tmp_path / "one")
        torch.set_num_threads(2)
        run(benchmark, tmp_path / "two", limit=2)
        first = rows_of(benchmark, tmp_path / "two")
        run(benchmark, tmp_path / "two")
    finally:
        torch.set_num_threads(before)
    one, two = (rows_of(benchmark, tmp_path / name) for name in ("one", "two"))
    assert without_seconds(one) == without_seconds(two)
    assert len(first) == 2
    assert {key: two[key] for key in first} == first, "seconds included: nothing was registered twice"


def test_flat_photograph_is_a_miss(pascal, tmp_path, monkeypatch):
    monkeypatch.setattr("curvireg_torch.evaluation.predict.read_image", lambda _: torch.full((3, 60, 80), 0.5))
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    summary = run(benchmark, tmp_path / "out")
    assert (summary["n"], summary["failed"], summary["acc_pi_6"]) == (4, 4, 0.0)
    assert rows_of(benchmark, tmp_path / "out")["car/2008_000001/0"]["failed"].startswith("the box shows one colour")


def test_defects_end_the_run(pascal, tmp_path, monkeypatch):
    def broken(*_, **__):
        raise RenderingError("no renderer")

    monkeypatch.setattr("curvireg_torch.evaluation.predict.cached_bank", broken)
    with pytest.raises(RenderingError):
        run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out")


def test_other_settings_are_refused(pascal, tmp_path):
    run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out")
    other = Pascal3DBenchmark(pascal, Protocol(pose="any"))
    with pytest.raises(InvalidInputError, match=r"other settings \(pipeline: .*protocol: .*--overwrite"):
        run(other, tmp_path / "out")
    summary = score(other, tmp_path / "out")
    assert summary["protocol"] == str(Protocol()), "that of the results"
    assert run(other, tmp_path / "out", overwrite=True)["protocol"] == str(other.protocol)


@pytest.mark.parametrize("options", [{"limit": 0}, {"limit": -1}, {"preset": "best"}])
def test_bad_options_are_refused(pascal, tmp_path, options):
    with pytest.raises(InvalidInputError, match=next(iter(options))):
        run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out", **options)


def test_selection_is_spread(pascal):
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    assert [item.index for item in benchmark.selection(2)] == [0, 2]
    assert [item.index for item in benchmark.selection(9)] == [0, 1, 2, 3, 4]


def test_settings_name_the_users_field(pascal, tmp_path):
    run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out", field=ImageGradient(), limit=1)
    assert ResultStore(tmp_path / "out").settings()["pipeline"]["field"] == "custom:ImageGradient"


def test_changed_photographs_are_registered_again(pascal, tmp_path):
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    run(benchmark, tmp_path / "out")
    before = rows_of(benchmark, tmp_path / "out")
    photographs = pascal.root / "Images" / "car_pascal"
    (photographs / "2008_000003.jpg").write_bytes((photographs / "2008_000001.jpg").read_bytes())
    image = cv2.imread(str(photographs / "2008_000002.jpg"))
    cv2.imwrite(str(photographs / "2008_000002.jpg"), image[::-1])
    run(benchmark, tmp_path / "out")
    after = rows_of(benchmark, tmp_path / "out")
    assert before["car/2008_000003/8"]["skipped"] == "unreadable_image"
    assert "on its shorter side" in after["car/2008_000003/8"]["failed"], "read now; its box is too small"
    assert after["car/2008_000001/0"] == before["car/2008_000001/0"], "seconds included"
    for key in ("car/2008_000002/1", "car/2008_000002/2"):
        assert after[key]["score"] != before[key]["score"]
