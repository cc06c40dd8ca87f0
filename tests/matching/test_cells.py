"""The packing of views, and their appearance, which is described once and stored."""

import gc

import pytest
import torch

from curvireg_torch import Pipeline, ViewMatcher, sample_views
from curvireg_torch.matching import cached_bank, clear_cache, list_cache
from curvireg_torch.matching.cells import DescribedViews, best_cells, cells_of_views
from curvireg_torch.synthetic import example_mesh
from tests._support import scene


def test_every_view_belongs_to_its_nearest_representative():
    R = sample_views(azimuth_step=10, elevations=[0]).rotations
    cells = cells_of_views(R, torch.tensor([0, 6, 12]))  # azimuths 0, 60, 120
    assert cells[:3].tolist() == [0, 0, 0]
    assert cells[4:9].tolist() == [1] * 5
    assert cells[35] == 0, "azimuth 350 is near 0"


def test_best_cells_are_those_of_the_best_views():
    log_scores = torch.tensor([-5.0, -1.0, -3.0, -torch.inf, -2.0, -4.0])
    cells = torch.tensor([0, 1, 1, 2, 3, 0])
    assert best_cells(log_scores, cells, count=2).tolist() == [1, 3]
    assert best_cells(log_scores, cells, count=9).tolist() == [1, 3, 0], (
        "cell 2 has no view that is allowed"
    )


def described(views):
    return torch.tensor([[float(view), 2.0] for view in views]).half()


def refuse(views):
    raise AssertionError(f"views {views} are described again")


def test_views_are_described_once_and_stored(tmp_path):
    path = tmp_path / "views.safetensors"
    first = DescribedViews(path)
    assert first.features([3, 5], described)[:, 0].tolist() == [3, 5]
    assert first.features([5, 3], refuse)[:, 0].tolist() == [5, 3]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        del first
        gc.collect()
    second = DescribedViews(path)
    assert torch.equal(second.features([3, 5], refuse), described([3, 5]))
    new = second.features([3, 7], lambda views: described(views) if views == [7] else None)
    assert new.shape == (2, 2)


def test_processes_add_to_one_file(tmp_path):
    path = tmp_path / "views.safetensors"
    both = [DescribedViews(path), DescribedViews(path)]
    both[0].features([1], described)
    both[1].features([2], described)
    both.clear()
    gc.collect()
    assert DescribedViews(path).features([1, 2], refuse)[:, 0].tolist() == [1, 2]


def test_a_damaged_file_counts_as_none(tmp_path):
    path = tmp_path / "views.safetensors"
    path.write_bytes(b"no safetensors")
    assert DescribedViews(path).features([1], described)[0].tolist() == [1, 2]


@pytest.mark.slow
def test_matcher_of_a_cached_bank_describes_no_view_twice(tmp_path, monkeypatch):
    pipeline = Pipeline(field="focus", box_jitter=0.0).with_term(
        "appearance", exhaustive_limit=0, top=3
    )
    views = sample_views(azimuth_step=60, elevations=[0, 30])
    image, box, _ = scene(0)

    def ranking():
        bank = cached_bank(
            example_mesh(), views, pipeline=pipeline, folder=tmp_path, progress=False
        )
        result = ViewMatcher(bank)([image], box[None])
        gc.collect()
        return result

    first = ranking()
    files = [path.name for path in (tmp_path / "banks").iterdir()]
    assert sorted(name.split("-")[0] for name in files) == ["bank", "views"]
    monkeypatch.setattr(ViewMatcher, "_describe_views", lambda _, views: refuse(views))
    again = ranking()
    assert torch.equal(first.scores, again.scores)
    assert len(list_cache(tmp_path)) == 1
    assert clear_cache(tmp_path) == 1
    assert not list((tmp_path / "banks").iterdir())
