"""Registration of an object to one of several CADs, and the options that reach it."""

from dataclasses import replace

import pytest
import torch
import trimesh

from curvireg_torch.data import read_image
from curvireg_torch.evaluation import Pascal3DBenchmark, Protocol, predict
from curvireg_torch.geometry import rotation_error
from curvireg_torch.matching import ViewBank, ViewMatcher
from curvireg_torch.mesh import load_mesh

from .helpers import rows_of, run
from .small import SMALL

UPRIGHT = SMALL.with_pose_prior("upright")
VIEWS = UPRIGHT.views.sphere()
BOX = torch.tensor([[10.0, 5, 70, 55]])


def bank_of(*extents):
    meshes = map(trimesh.creation.box, extents)
    return ViewBank.join([ViewBank.build(mesh, VIEWS, pipeline=SMALL, progress=False) for mesh in meshes])


@pytest.fixture
def image():
    return torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def two_cars(pascal):
    """A second CAD of a car, of another shape."""
    trimesh.creation.box((0.2, 0.9, 0.2)).export(pascal.root / "CAD" / "car" / "02.off")
    return pascal


def test_cad_any_takes_the_best_view_of_all(two_cars, tmp_path):
    folder = two_cars.root / "CAD" / "car"
    benchmark = Pascal3DBenchmark(two_cars, Protocol(cad="any"))
    run(benchmark, tmp_path)
    banks = [ViewBank.build(load_mesh(p), pipeline=UPRIGHT, progress=False) for p in sorted(folder.iterdir())]
    bank = ViewBank.join(banks)
    rows = {key: row for key, row in rows_of(benchmark, tmp_path).items() if "rotation" in row}
    assert rows
    for item in benchmark.items:
        if item.key in rows:
            row = rows[item.key]
            scores = ViewMatcher(bank, pipeline=UPRIGHT)([read_image(item.photo)], item.box[None]).scores[0].detach()
            # A box has the same silhouette from two sides: views with equal scores may change places.
            same = rotation_error(bank.rotations, torch.tensor(row["rotation"])) < 0.1
            mine = same & (bank.model == ["01.off", "02.off"].index(row["mesh"]))
            assert float(scores[mine]) == pytest.approx(float(scores.max()), rel=1e-3)


def test_fused_matcher_takes_the_best_view_on_average(image):
    bank = bank_of((1, 2, 1), (1, 1, 3))
    scores = ViewMatcher(bank)([image], BOX).scores.detach().view(2, len(VIEWS))
    with torch.no_grad():
        ranking = predict.FusedMatcher(bank)([image], BOX)
    best = int(scores.mean(0).argmax())
    model = int(scores[:, best].argmax())
    assert int(ranking.order[0, 0]) == model * len(VIEWS) + best
    assert float(ranking.scores.max()) == pytest.approx(float(scores.mean(0).max()))
    assert int((ranking.scores > 0).sum()) == len(VIEWS), "each view counts once"


def test_fused_matcher_gives_equal_scores_to_the_first_model(image):
    bank = bank_of((1, 2, 1))
    with torch.no_grad():
        scores = predict.FusedMatcher(ViewBank.join([bank, bank]))([image], BOX).scores[0]
        torch.testing.assert_close(scores[: len(VIEWS)], ViewMatcher(bank)([image], BOX).scores[0])
    assert not scores[len(VIEWS) :].any()


@pytest.mark.parametrize("cad", ["any", "fused"])
def test_protocol_and_pipeline_reach_the_matcher(two_cars, tmp_path, monkeypatch, cad):
    matchers = []
    name = "FusedMatcher" if cad == "fused" else "ViewMatcher"
    original = getattr(predict, name)
    monkeypatch.setattr(predict, name, lambda *a, **k: matchers.append(original(*a, **k)) or matchers[-1])
    benchmark = Pascal3DBenchmark(two_cars, Protocol(cad=cad))
    run(benchmark, tmp_path, preset=replace(SMALL, box_jitter=0.05), limit=1)
    assert matchers[0].pipeline.box_jitter == 0.05
    assert matchers[0].pipeline.views.pose == "upright"
    (row,) = rows_of(benchmark, tmp_path).values()
    assert len(matchers[0].bank.meshes) == 2
    assert row["mesh"] == row["top"][0]["mesh"]
