import json

import pytest
import torch
import trimesh

from curvireg_torch.data import read_bop_csv
from curvireg_torch.errors import InvalidInputError, RenderingError
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol, estimate, evaluate
from curvireg_torch.evaluation.store import PredictionStore
from curvireg_torch.registration import Registrar

from .small import SMALL, SmallPreset


def run(benchmark, out, **options):
    return evaluate(benchmark, out, progress=False, **options)


def rows_of(benchmark, out):
    store = PredictionStore(out / "predictions")
    return {item.key: store.read(item.key) for item in benchmark.items if item.key in store}


def without_seconds(rows):
    return {key: {name: v for name, v in row.items() if name != "seconds"} for key, row in rows.items()}


def test_pascal3d(pascal, tmp_path):
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    summary = run(benchmark, tmp_path / "out")
    assert summary["n"] == 3
    assert {k: summary["skipped"][k] for k in ("unreadable_image", "unreadable_mesh")} == {
        "unreadable_image": 1, "unreadable_mesh": 1,
    }  # fmt: skip
    assert summary["skipped"]["missing_image"] == 1, "what the dataset left out is counted, too"
    assert "other_class" not in summary["skipped"], "those are no cars and sofas"
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
    R = torch.tensor(good["rotation"], dtype=torch.float64)
    torch.testing.assert_close(R @ R.T, torch.eye(3).double(), atol=1e-6, rtol=0)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"predictions", "predictions.csv", "summary.json"}
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["protocol"] == str(Protocol())


def test_bop(bop, tmp_path):
    summary = run(BOPBenchmark(bop, Protocol(pose="any")), tmp_path / "out")
    assert summary["n"] == 3
    assert summary["skipped"]["unknown_box"] == 1, "no scene_gt_info, no box"
    assert summary["failed"] == 0
    table = read_bop_csv(tmp_path / "out" / "predictions.csv")
    assert len(table) == 3
    assert all(row["t"][2] > 0 for row in table)


def test_flat_photograph_is_a_miss(pascal, tmp_path, monkeypatch):
    monkeypatch.setattr("curvireg_torch.evaluation.predict.read_image", lambda _: torch.full((3, 60, 80), 0.5))
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    summary = run(benchmark, tmp_path / "out")
    assert (summary["n"], summary["failed"], summary["acc_pi_6"]) == (4, 4, 0.0)


def test_a_defect_is_not_counted_as_a_miss(pascal, tmp_path, monkeypatch):
    def broken(*_, **__):
        raise RenderingError("no renderer")

    monkeypatch.setattr("curvireg_torch.evaluation.predict.cached_bank", broken)
    with pytest.raises(RenderingError):
        run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out")


def test_goes_on_where_it_was(pascal, tmp_path):
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    run(benchmark, tmp_path / "whole")
    first = run(benchmark, tmp_path / "out", limit=2)
    assert first["n"] == 2 - sum(first["skipped"].get(k, 0) for k in ("unreadable_image", "unreadable_mesh"))
    before = rows_of(benchmark, tmp_path / "out")
    assert len(before) == 2
    run(benchmark, tmp_path / "out")
    after = rows_of(benchmark, tmp_path / "out")
    assert {key: after[key] for key in before} == before, "seconds included: nothing was done twice"
    assert without_seconds(after) == without_seconds(rows_of(benchmark, tmp_path / "whole"))


def test_other_settings_are_refused(pascal, tmp_path):
    run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out")
    other = Pascal3DBenchmark(pascal, Protocol(pose="any"))
    with pytest.raises(InvalidInputError, match=r"other settings \(preset: .*protocol: .*--overwrite"):
        run(other, tmp_path / "out")
    assert run(other, tmp_path / "out", overwrite=True)["protocol"] == str(other.protocol)


@pytest.mark.parametrize("limit", [0, -1])
def test_bad_limit(pascal, tmp_path, limit):
    with pytest.raises(InvalidInputError, match="limit"):
        run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out", limit=limit)


def test_unknown_preset(pascal, tmp_path):
    with pytest.raises(InvalidInputError, match="preset"):
        run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out", preset="best")


def test_limit_is_spread(pascal):
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    assert [item.index for item in benchmark.selection(2)] == [0, 2]
    assert [item.index for item in benchmark.selection(9)] == [0, 1, 2, 3, 4]


def test_any_cad_takes_the_better_score(pascal, tmp_path):
    folder = pascal.root / "CAD" / "car"
    trimesh.creation.box((0.2, 0.9, 0.2)).export(folder / "02.off")
    runs = {}
    for name, cad in (("any", "any"), ("first", "annotated")):
        benchmark = Pascal3DBenchmark(pascal, Protocol(cad=cad))
        run(benchmark, tmp_path / name)
        runs[name] = rows_of(benchmark, tmp_path / name)
    folder.joinpath("01.off").write_bytes(folder.joinpath("02.off").read_bytes())
    run(benchmark, tmp_path / "second")
    runs["second"] = rows_of(benchmark, tmp_path / "second")
    chosen = set()
    for key, row in runs["any"].items():
        if "rotation" in row:
            alone = {"01.off": runs["first"][key], "02.off": runs["second"][key]}
            assert row["score"] == max(r["score"] for r in alone.values())
            assert row["rotation"] == alone[row["mesh"]]["rotation"]
            chosen.add(row["mesh"])
    assert chosen


def test_fused_takes_the_view_that_is_best_on_average(monkeypatch):
    seen = []

    def spy(registrar, field, order):
        seen.append(int(order[0]))
        return search(registrar, field, order)

    search = Registrar.search
    monkeypatch.setattr(Registrar, "search", spy)
    registrars = [
        Registrar(trimesh.creation.box(extents), views=SMALL.views("upright"), settings=SMALL.bank, refine=False)
        for extents in ((1, 2, 1), (1, 1, 3))
    ]
    image, box = torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(0)), torch.tensor([10.0, 5, 70, 55])
    row = estimate.estimate_pose(registrars, image, box, None, fused=True)
    scores = torch.cat([r.matcher([image], box[None]).scores for r in registrars])
    best = scores.mean(0).argmax()
    assert seen == [int(best)]
    assert row["mesh"] == int(scores[:, best].argmax())


def test_the_presets_options_reach_the_matcher(pascal, tmp_path):
    seen = []

    class Watched(SmallPreset):
        def registrar(self, bank, **options):
            made = super().registrar(bank, **options)
            seen.append(made.matcher)
            return made

    evaluate(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out", preset=Watched(matcher={"slack": 0.05}), limit=1)
    assert seen[0].slack == 0.05
