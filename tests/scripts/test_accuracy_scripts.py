"""The scripts behind docs/accuracy.md."""

import json
import re
from collections import Counter

import pytest
import torch

from curvireg_torch.data import BOPDataset
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol
from tests._support.real_data import real_data
from tests._support.scripts import ROOT, SCRIPTS, imported

STAGES = ("view", "search", "contours")


@pytest.fixture
def ablate():
    with imported("scripts._shared") as script:
        yield script


@pytest.mark.parametrize("members", [1, 5])
def test_interval_is_that_of_a_share_of_units(ablate, members):
    """Against the normal approximation of a binomial share: copies of a photograph make nothing surer."""
    values = (torch.arange(400) % 4 == 0).float().repeat(members)
    mean, low, high = ablate.interval(values, [f"unit {k % 400}" for k in range(400 * members)])
    assert mean == 0.25
    half = 1.96 * (0.25 * 0.75 / 400) ** 0.5
    assert low == pytest.approx(mean - half, abs=0.006)
    assert high == pytest.approx(mean + half, abs=0.006)


def test_paired_differences_are_sharper_than_their_parts(ablate):
    one = (torch.arange(100) % 2).float()
    better = one.clone()
    better[::20] = 1.0
    mean, low, high = ablate.interval(better - one, range(100))
    assert mean == pytest.approx(0.05)
    assert low >= 0.0
    assert high <= 0.1


def test_there_is_one_median():
    """``Tensor.median`` takes the lower of the middle two; ``median_error`` and ``quantile(0.5)`` take their mean."""
    sources = [*(ROOT / "curvireg_torch").rglob("*.py"), *SCRIPTS.rglob("*.py")]
    assert len(sources) > 200
    assert [path.name for path in sources if re.search(r"\.(nan)?median\(\)", path.read_text(encoding="utf-8"))] == []


def test_unequal_units_weigh_by_their_members(ablate):
    """A hundred units of nine right members each, and a hundred of one wrong member."""
    mean, low, high = ablate.interval([1.0] * 900 + [0.0] * 100, [k // 9 for k in range(900)] + list(range(100, 200)))
    assert mean == 0.9
    assert 0.85 < low < 0.9 < high < 0.93


def test_independent_units(pascal, bop):
    """Objects of one CAD; an object of a scene in one pose, under whatever light."""
    with imported("scripts._shared") as intervals:
        benchmark = Pascal3DBenchmark(pascal, Protocol())
        meshes = [item.meshes for item in benchmark.items]
        units = intervals.independent_units(benchmark)
        assert [units[i] == units[k] for i in range(5) for k in range(5)] == [a == b for a in meshes for b in meshes]
        path = bop.root / "test" / "000001"
        for name in ("scene_gt", "scene_gt_info", "scene_camera"):
            kept = json.loads((path / f"{name}.json").read_text())
            (path / f"{name}.json").write_text(json.dumps({"0": kept["0"], "3": kept["0"]}))
        benchmark = BOPBenchmark(BOPDataset(bop.root, targets=False), Protocol(pose="any"))
        units = intervals.independent_units(benchmark)
        keys = [item.key for item in benchmark.items]
        assert keys == ["1/0/0", "1/0/1", "1/0/2", "1/3/0", "1/3/1", "1/3/2", "2/7/0"]
        assert units == [0, 1, 2, 0, 1, 2, 3]


def test_hope_is_sixteen_views_in_five_lightings():
    objects = BOPBenchmark(BOPDataset(real_data("bop/hope")), Protocol(pose="any"))
    with imported("scripts._shared") as intervals:
        assert set(Counter(intervals.independent_units(objects)).values()) == {5}
        assert len(set(intervals.independent_units(objects))) == 16


@pytest.fixture
def runner():
    with imported("scripts.benchmark.run") as script:
        yield script


def test_wrong_meshes_are_no_copies_and_of_the_kind_where_asked(runner):
    kinds = {"a": "chair", "b": "chair", "c": "car", "d": "chair", "e": None, "f": None}
    items = [{"mesh": mesh, "kind": kind} for mesh, kind in kinds.items()]
    like = {**{mesh: mesh for mesh in kinds}, "b": "a"}
    assert runner.wrong_meshes(None, items, like) == dict.fromkeys(kinds)
    assert runner.wrong_meshes("any", items, like) == dict(zip("abcdef", "ccdefa", strict=True))
    assert runner.wrong_meshes("kind", items, like) == {"a": "d", "b": "d", "d": "a"}, "no car stands by"
