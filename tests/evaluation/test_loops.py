import itertools
import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import pytest
import torch
import trimesh

from curvireg_torch.data import BOPDataset, read_bop_csv
from curvireg_torch.errors import InvalidInputError, RenderingError
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol, estimate, evaluate, predict, score
from curvireg_torch.evaluation.store import PredictionStore
from curvireg_torch.filters import ImageGradient
from curvireg_torch.geometry import rotation_error
from curvireg_torch.io import read_image
from curvireg_torch.io.meshes import load_mesh
from curvireg_torch.matching import ViewBank, ViewMatcher
from curvireg_torch.registration import Registrar
from curvireg_torch.registration.inputs import ImageItem

from .small import SMALL


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


def test_what_is_refused_of_one_object_fails_it_alone(bop, tmp_path):
    benchmark = BOPBenchmark(bop, Protocol(pose="any"))
    first, second, third = benchmark.items[:3]
    oblong = first.camera_matrix.clone()
    oblong[0, 0] *= 1.3
    benchmark.items[0] = replace(first, camera_matrix=oblong)
    benchmark.items[1] = replace(second, box=second.box + 5000.0)
    summary = run(benchmark, tmp_path / "out")
    rows = rows_of(benchmark, tmp_path / "out")
    assert "square pixels" in rows[first.key]["failed"]
    assert "wholly outside" in rows[second.key]["failed"]
    assert "rotation" in rows[third.key]
    assert summary["failed"] == 2


def test_an_object_whose_box_is_unknown_can_be_looked_for(bop, tmp_path):
    benchmark = BOPBenchmark(bop, Protocol(pose="any", box=None))
    run(benchmark, tmp_path / "out")
    unknown = [item.key for item in benchmark.items if not bool(item.box.isfinite().all())]
    rows = rows_of(benchmark, tmp_path / "out")
    assert unknown
    assert all("skipped" not in rows[key] for key in unknown)


def test_predictions_are_the_same_to_the_bit_on_other_threads_and_resumed(pascal, tmp_path):
    benchmark, before = Pascal3DBenchmark(pascal, Protocol()), torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        run(benchmark, tmp_path / "one")
        torch.set_num_threads(2)
        run(benchmark, tmp_path / "two")
        kept = PredictionStore(tmp_path / "two" / "predictions")
        done = [key for key, row in rows_of(benchmark, tmp_path / "two").items() if "rotation" in row]
        assert len(done) >= 2
        kept._path(done[0]).unlink()
        run(benchmark, tmp_path / "two")
    finally:
        torch.set_num_threads(before)
    one, two = (without_seconds(rows_of(benchmark, tmp_path / name)) for name in ("one", "two"))
    assert one == two


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
    assert without_seconds(after), without_seconds(rows_of(benchmark == tmp_path / "whole"))


def test_other_settings_are_refused(pascal, tmp_path):
    run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out")
    other = Pascal3DBenchmark(pascal, Protocol(pose="any"))
    with pytest.raises(InvalidInputError, match=r"other settings \(pipeline: .*protocol: .*--overwrite"):
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


def test_any_cad_takes_the_one_that_ranks_first(pascal, tmp_path):
    folder = pascal.root / "CAD" / "car"
    trimesh.creation.box((0.2, 0.9, 0.2)).export(folder / "02.off")
    benchmark = Pascal3DBenchmark(pascal, Protocol(cad="any"))
    run(benchmark, tmp_path / "any")
    pipeline = SMALL.with_pose_prior("upright")
    bank = ViewBank.join(
        [ViewBank.build(load_mesh(p), pipeline=pipeline, progress=False) for p in sorted(folder.iterdir())]
    )
    chosen = set()
    for item in benchmark.items:
        row = rows_of(benchmark, tmp_path / "any")[item.key]
        if "rotation" in row:
            image = read_image(pascal.annotation(item.index)["image_path"])
            scores = ViewMatcher(bank, pipeline=pipeline)([image], item.box[None]).scores[0].detach()
            # A box looks alike from two sides: views that tie may change places.
            found = torch.tensor(row["rotation"])
            same = rotation_error(bank.rotations, found) < 0.1
            mine = same & (bank.model == ["01.off", "02.off"].index(row["mesh"]))
            assert float(scores[mine]) == pytest.approx(float(scores.max()), rel=1e-3)
            chosen.add(row["mesh"])
    assert chosen


def test_fused_takes_the_view_that_is_best_on_average():
    views = SMALL.with_pose_prior("upright").views.sphere()
    bank = ViewBank.join(
        [
            ViewBank.build(trimesh.creation.box(extents), views, pipeline=SMALL, progress=False)
            for extents in ((1, 2, 1), (1, 1, 3))
        ]
    )
    image, box = torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(0)), torch.tensor([10.0, 5, 70, 55])
    scores = ViewMatcher(bank)([image], box[None]).scores.detach().view(2, len(views))
    matcher = estimate.FusedMatcher(bank)
    with torch.no_grad():
        ranking = matcher([image], box[None])
    best = int(scores.mean(0).argmax())
    model = int(scores[:, best].argmax())
    assert int(ranking.order[0, 0]) == model * len(views) + best
    assert float(ranking.scores.max()) == pytest.approx(float(scores.mean(0).max()))
    assert int((ranking.scores > 0).sum()) == len(views), "each view stands once"
    row = estimate.estimate_poses(Registrar(matcher), [ImageItem(image, box, None)])[0]
    assert row["mesh"] == model


def test_the_pipelines_options_reach_the_matcher(pascal, tmp_path, monkeypatch):
    seen = []
    made = predict.ViewMatcher
    monkeypatch.setattr(predict, "ViewMatcher", lambda *a, **k: seen.append(made(*a, **k)) or seen[-1])
    evaluate(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out", preset=replace(SMALL, box_jitter=0.05), limit=1)
    assert seen[0].pipeline.box_jitter == 0.05
    assert seen[0].pipeline.views.pose == "upright"


def test_a_field_of_ones_own_is_noted(pascal, tmp_path):
    evaluate(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out", field=ImageGradient(), limit=1)
    settings = PredictionStore(tmp_path / "out" / "predictions").read("settings")
    assert settings["pipeline"]["field"] == "custom:ImageGradient"


def test_repaired_and_changed_files_are_registered_again(pascal, tmp_path):
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
    assert "rotation" in after["car/2008_000003/8"]
    assert after["car/2008_000001/0"] == before["car/2008_000001/0"], "seconds included"
    for key in ("car/2008_000002/1", "car/2008_000002/2"):
        assert after[key]["score"] != before[key]["score"]


def registered_again(benchmark, out, fresh):
    """The keys that a resumed run registers again; its rows must be those of a fresh run."""
    before = rows_of(benchmark, out)
    run(benchmark, out)
    after = rows_of(benchmark, out)
    run(benchmark, fresh)
    assert without_seconds(after), without_seconds(rows_of(benchmark == fresh))
    return {key for key in after if after[key] != before[key]}


def test_a_camera_put_right_is_registered_again(bop, tmp_path):
    def benchmark():
        return BOPBenchmark(BOPDataset(bop.root, targets=False), Protocol(pose="any"))

    run(benchmark(), tmp_path / "out")
    before = rows_of(benchmark(), tmp_path / "out")
    path = bop.root / "test" / "000001" / "scene_camera.json"
    cameras = json.loads(path.read_text())
    cameras["0"]["cam_K"][0] = cameras["0"]["cam_K"][4] = 450.0
    path.write_text(json.dumps(cameras))
    again = registered_again(benchmark(), tmp_path / "out", tmp_path / "fresh")
    mine = {item.key for item in benchmark().items if item.key.startswith("1/0/")}
    assert again == mine
    assert len(mine) < len(before), "others have the camera that they had"
    after = rows_of(benchmark(), tmp_path / "out")
    key = min(mine)
    assert after[key]["translation"][2] == pytest.approx(1.5 * before[key]["translation"][2], rel=0.1)


@pytest.mark.parametrize(("name", "place"), [("box", k) for k in range(4)] + [("camera", k) for k in (0, 2, 4, 5)])
def test_numbers_that_differ_by_a_hair_are_registered_again(bop, name, place):
    benchmark = BOPBenchmark(bop, Protocol(pose="any"))
    item = benchmark.items[0]
    changed = {"box": item.box + 1000.0, "camera": item.camera_matrix.clone()}
    first = replace(item, box=changed["box"].clone())
    changed[name].view(-1)[place] += 1e-3
    second = replace(item, box=changed["box"], camera_matrix=changed["camera"])
    digests = [predict.input_digests(benchmark, [one])[item.key] for one in (first, second)]
    assert {key for key in digests[0] if digests[0][key] != digests[1][key]} == {name}
    assert predict.input_digests(benchmark, [replace(item, camera_matrix=None)])[item.key]["camera"] == ""


def test_a_changed_texture_is_registered_again(bop):
    path = bop.root / "models" / "obj_000001.ply"
    path.write_text(path.read_text().replace("ascii 1.0\n", "ascii 1.0\ncomment TextureFile skin.png\n"))
    cv2.imwrite(str(path.with_name("skin.png")), torch.zeros(4, 4, 3, dtype=torch.uint8).numpy())
    benchmark = BOPBenchmark(bop, Protocol(pose="any"))
    before = predict.input_digests(benchmark, benchmark.items)
    cv2.imwrite(str(path.with_name("skin.png")), torch.ones(4, 4, 3, dtype=torch.uint8).numpy())
    after = predict.input_digests(benchmark, benchmark.items)
    changed = {item.key for item in benchmark.items if before[item.key] != after[item.key]}
    assert changed == {item.key for item in benchmark.items if item.meshes == (path,)}
    assert changed


def test_scores_tell_the_protocol_of_the_predictions(pascal, tmp_path):
    run(Pascal3DBenchmark(pascal, Protocol()), tmp_path / "out")
    summary = score(Pascal3DBenchmark(pascal, Protocol(pose="any")), tmp_path / "out")
    assert summary["protocol"] == str(Protocol())


def test_an_object_whose_box_was_changed_is_registered_again(pascal, tmp_path):
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    run(benchmark, tmp_path / "out", limit=2)
    before = rows_of(benchmark, tmp_path / "out")
    item = next(item for item in benchmark.items if "rotation" in before.get(item.key, {}))
    corrected = Pascal3DBenchmark(pascal, Protocol())
    moved = replace(item, box=item.box + torch.tensor([4.0, 3.0, 0.0, 0.0]))
    corrected.items = [moved if one.key == item.key else one for one in corrected.items]
    run(corrected, tmp_path / "out", limit=2)
    after = rows_of(benchmark, tmp_path / "out")
    assert [key for key in before if after[key] != before[key]] == [item.key]
    assert after[item.key]["score"] != before[item.key]["score"]


def test_seconds_of_a_batch_are_shared_by_its_objects(pascal, tmp_path, monkeypatch):
    """By a clock that goes one second further each time that it is looked at, a batch takes two."""
    clock = itertools.count()
    monkeypatch.setattr(predict, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    run(benchmark, tmp_path / "out")
    found = [row["seconds"] for row in rows_of(benchmark, tmp_path / "out").values() if "rotation" in row]
    assert found == [{"bank": pytest.approx(1 / 3), "register": pytest.approx(1 / 3)}] * 3


def test_fused_models_that_agree_share_nothing():
    """Two models that are the same score alike from everywhere: each view stands once all the same, at the first."""
    views = SMALL.with_pose_prior("upright").views.sphere()
    bank = ViewBank.build(trimesh.creation.box((1, 2, 1)), views, pipeline=SMALL, progress=False)
    image, box = torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(0)), torch.tensor([[10.0, 5, 70, 55]])
    with torch.no_grad():
        scores = estimate.FusedMatcher(ViewBank.join([bank, bank]))([image], box).scores[0]
        torch.testing.assert_close(scores[: len(views)], ViewMatcher(bank)([image], box).scores[0])
    assert not scores[len(views) :].any()
