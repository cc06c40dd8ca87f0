"""Registration of an object to one of several CADs, and the options that reach it."""

from dataclasses import replace

import pytest
import torch
import trimesh

from curvireg_torch.data import read_image
from curvireg_torch.evaluation import Pascal3DBenchmark, Protocol, predict
from curvireg_torch.matching import ViewBank, ViewMatcher
from curvireg_torch.mesh import load_mesh

from .helpers import rows_of, run
from .small import SMALL

UPRIGHT = SMALL.with_pose_prior("upright")


@pytest.fixture
def two_cars(pascal):
    """A second CAD of a car, of another shape."""
    trimesh.creation.box((0.2, 0.9, 0.2)).export(pascal.root / "CAD" / "car" / "02.off")
    return pascal


def test_cad_any_takes_the_best_of_all(two_cars, tmp_path):
    """Without confidence, the mesh whose best view is most similar to the photograph."""
    folder = two_cars.root / "CAD" / "car"
    benchmark = Pascal3DBenchmark(two_cars, Protocol(cad="any"))
    run(benchmark, tmp_path)
    banks = {p.name: ViewBank.build(load_mesh(p), pipeline=UPRIGHT, progress=False) for p in folder.iterdir()}
    rows = {key: row for key, row in rows_of(benchmark, tmp_path).items() if "rotation" in row}
    assert rows
    for item in benchmark.items:
        if item.key in rows and len(item.meshes) == 2:
            scores = {}
            for name, bank in banks.items():
                with torch.no_grad():
                    ranking = ViewMatcher(bank, pipeline=UPRIGHT)([read_image(item.photo)], item.box[None])
                scores[name] = float(ranking.hog[0, ranking.order[0, 0]])
            assert rows[item.key]["mesh"] == max(scores, key=scores.__getitem__)


def test_protocol_and_pipeline_reach_the_registrar(two_cars, tmp_path, monkeypatch):
    registrars, init = [], predict.Registrar.__init__
    monkeypatch.setattr(
        predict.Registrar, "__init__", lambda self, *a, **k: registrars.append(self) or init(self, *a, **k)
    )
    benchmark = Pascal3DBenchmark(two_cars, Protocol(cad="any"))
    run(benchmark, tmp_path, preset=replace(SMALL, box_jitter=0.05), limit=1)
    for registrar in (registrars[0], *registrars[0].others):
        assert registrar.pipeline.box_jitter == 0.05
        assert registrar.pipeline.views.pose == "upright"
    assert len(registrars[0].others) == 1
