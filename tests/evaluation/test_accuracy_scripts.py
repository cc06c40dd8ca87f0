"""The scripts behind docs/accuracy.md."""

import json
import math
import re
from collections import Counter

import numpy as np
import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.data import BOPDataset
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol
from tests._support.real_data import real_data
from tests._support.scenes import CAMERA, scene, truck_bank
from tests._support.scripts import ROOT, SCRIPTS, imported

STAGES = ("view", "search", "contours")


@pytest.fixture
def ablate():
    with imported("ablate") as script:
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
    sources = [*(ROOT / "curvireg_torch").rglob("*.py"), *SCRIPTS.glob("*.py")]
    assert len(sources) > 200
    assert [path.name for path in sources if re.search(r"\.(nan)?median\(\)", path.read_text(encoding="utf-8"))] == []


def test_medians_of_the_refinement_are_means_of_the_middle_two():
    numbers = [1.0, 2.0, 4.0, 9.0]
    names = [f"{what} {stage}" for what in ("rotation", "translation", "seconds") for stage in STAGES]
    with imported("measure_refinement") as script:
        found = script.summary([{**dict.fromkeys(names, x), "sigmas": x} for x in numbers[:-1]])
        assert (found["search: rotation median"], found["sigmas"]) == (2.0, 2.0)
        rows = [{**dict.fromkeys(names, x), "sigmas": math.nan if x == 4.0 else x} for x in numbers]
        found = script.summary(rows)
    medians = [found[f"contours: {name}"] for name in ("rotation median", "translation median %", "seconds")]
    assert medians == [3.0, 3.0, 3.0]
    assert found["sigmas"] == 1.5, "of 1 and 2; 4 is unknown and 9 too far off"


def test_unequal_units_weigh_by_their_members(ablate):
    """A hundred units of nine right members each, and a hundred of one wrong member."""
    mean, low, high = ablate.interval([1.0] * 900 + [0.0] * 100, [k // 9 for k in range(900)] + list(range(100, 200)))
    assert mean == 0.9
    assert 0.85 < low < 0.9 < high < 0.93


def test_independent_units(pascal, bop):
    """Objects of one CAD; an object of a scene in one pose, under whatever light."""
    with imported("_intervals") as intervals:
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
    with imported("_intervals") as intervals:
        assert set(Counter(intervals.independent_units(objects)).values()) == {5}
        assert len(set(intervals.independent_units(objects))) == 16


def test_table_has_a_line_for_every_row_that_was_measured(ablate):
    kept = {"errors": [5.0, 20.0, 50.0, 10.0], "whole": [True, True, False, False], "units": [0, 1, 2, 2]}
    worse = {**kept, "errors": [5.0, 80.0, 50.0, 10.0]}
    text = ablate.table({"learned": {"lm": kept}, "classical": {"lm": worse}})
    lines = text.splitlines()
    assert lines[0] == "**lm**"
    assert lines[4].startswith("| learned | 4 (3) | 0.750 (")
    assert "| 0.500 | 15.0° | 1.000 (2) |" in lines[4], "the mean of 10 and 20"
    assert lines[5].startswith("| classical | 4 (3) | 0.500 (")
    assert "-0.250 (" in lines[5]


@pytest.fixture
def verdicts():
    pytest.importorskip("sklearn", reason="scikit-learn is not installed")
    with imported("fit_verdict") as script:
        yield script


@pytest.fixture
def runner():
    with imported("run_benchmark") as script:
        yield script


def row(mesh, errors, evidence):
    names = ("rank", "similarity", "support", "appearance")
    known = [dict(zip(names, one, strict=True)) for one in evidence]
    return {"mesh": mesh, "form": "exact", "errors": errors, "evidence": known}


def test_shares_vary_with_meshes_not_with_photographs(verdicts):
    one = [row("a", [], [])] * 400
    assert verdicts.share([True] * 100 + [False] * 300, one) == [0.25, 0.25, 0.25], "one mesh: nothing to vary"
    each = [{**r, "mesh": f"m{k}"} for k, r in enumerate(one)]
    mean, low, high = verdicts.share([True] * 100 + [False] * 300, each)
    half = 1.96 * (0.25 * 0.75 / 400) ** 0.5
    assert mean == 0.25
    assert (low, high) == (pytest.approx(mean - half, abs=0.006), pytest.approx(mean + half, abs=0.006))


def test_the_verdict_without_each_piece_of_evidence(verdicts):
    """By support the first hypothesis is right, by rank and similarity the second."""
    rows = [row(f"m{k}", [5.0, 90.0], [(-1.0, 0.5, 0.9, 0.0), (0.0, 0.6, 0.1, 0.0)]) for k in range(3)]
    found = {name: mean for name, (mean, _, _) in verdicts.without(rows).items()}
    assert found == {"nothing": 1.0, "rank": 1.0, "similarity": 1.0, "support": 0.0, "appearance": 1.0}
    held = {
        "auc_right_answer": 0.75,
        "precision_at": {"0.5": [0.9, 0.4], "0.9": [None, 0.0]},
        "risk_at_coverage": {"1": 0.1},
    }
    shares = {key: [0.5, 0.25, 0.75] for key in ("best_view", "winner", "among_hypotheses")}
    alike = {"kind": {"auc": 0.625, "n": 8, "believed": 3, "right_of_them": 2}}
    result = {
        "shares": {"exact upright": {"n": 3, **shares}},
        "verdict": {"without": verdicts.without(rows)},
        "confidence": {"held_out": held, "right_mesh": alike},
    }
    text = verdicts.page(result)
    assert "| exact upright | 3 | 0.50 (0.25 to 0.75) | 0.50 (0.25 to 0.75) | 0.50 (0.25 to 0.75) |" in text
    assert "| exact photographs, verdict without | nothing | rank | similarity | support | appearance |" in text
    assert "| right | 1.000 | 1.000 | 1.000 | 0.000 | 1.000 |" in text
    assert "answers 0.75. Of right meshes against another mesh of the object's kind (8 photographs): 0.62;" in text
    assert "; of these wrong meshes 3 are believed, 2 of them with a pose within 30 degrees." in text


def test_wrong_meshes_are_no_copies_and_of_the_kind_where_asked(runner):
    kinds = {"a": "chair", "b": "chair", "c": "car", "d": "chair", "e": None, "f": None}
    items = [{"mesh": mesh, "kind": kind} for mesh, kind in kinds.items()]
    like = {**{mesh: mesh for mesh in kinds}, "b": "a"}
    assert runner.wrong_meshes(None, items, like) == dict.fromkeys(kinds)
    assert runner.wrong_meshes("any", items, like) == dict(zip("abcdef", "ccdefa", strict=True))
    assert runner.wrong_meshes("kind", items, like) == {"a": "d", "b": "d", "d": "a"}, "no car stands by"


@pytest.fixture
def believed():
    with imported("check_verdict") as script:
        yield script


def test_what_the_confidence_rests_on(believed):
    """Verdicts: 8, 6 and 4.5 with a camera; 0, -1 and -0.5, by rank alone, without."""
    rows = (0.0, 1.0, 0.3, 0.0), (-1.0, 1.0, 0.2, 0.0), (-0.5, 0.6, 0.2, 0.0)
    known = [dict(zip(("rank", "similarity", "support", "appearance"), one, strict=True)) for one in rows]
    assert believed.evidence_of(known, with_camera=True) == pytest.approx([1.0, 2.0, 1.0, 0.3]), "the nearest rival's"
    assert believed.evidence_of(known, with_camera=False) == pytest.approx([1.0, 0.5, 0.0, 0.3])
    assert believed.evidence_of(known[:1], with_camera=True) == pytest.approx([1.0, 5.0, 1.0, 0.3]), "alone"


def test_what_confidences_are_worth(believed):
    assert believed.auc(np.array([0.5, 0.9]), np.array([0.5, 0.1])) == pytest.approx(3.5 / 4), "a tie counts half"
    sure, right = np.array([0.9, 0.8, 0.6, 0.3]), np.array([True, True, False, True])
    found = believed.judged(sure, right)
    assert found["auc"] == pytest.approx(2 / 3)
    assert found["wrong_at"] == {"1": 0.25, "0.75": pytest.approx(1 / 3), "0.5": 0.0, "0.25": 0.0}
    assert (found["reliable"], found["right_of_them"]) == (0.5, 1.0)
    none = believed.judged(np.array([0.1, 0.2]), np.array([True, True]))
    assert (none["auc"], none["reliable"], none["right_of_them"]) == (None, 0.0, None)
    text = believed.table({"sets": {"lm": found, "dino": none}, "date": "today", "commit": "abc"})
    assert "| lm | 4 | 0.75 | 0.65 | 0.67 | 0.25 | 0.33 | 0.00 | 0.00 | 0.50 | 1.00 |" in text
    assert "| dino | 2 | 1.00 | 0.15 | - | 0.00 | 0.00 | 0.00 | 0.00 | 0.00 | - |" in text


def test_confidence_is_that_of_the_registration(believed):
    found = cr.Registrar(truck_bank())([scene(0)[0]], scene(0)[1][None], CAMERA)[0]
    kept = {"evidence": dict(found.hypotheses[0].evidence)}
    kept["rivals"] = [{"evidence": dict(h.evidence)} for h in found.hypotheses[1:]]
    assert believed.confidence_of(kept, with_camera=True) == pytest.approx(found.confidence)
    assert believed.confidence_of(kept, with_camera=False) != pytest.approx(found.confidence)
    assert believed.confidence_of({"failed": "no"}, with_camera=True) == 0.0
