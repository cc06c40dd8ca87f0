"""scripts/calibration: folds, fits, quality measures, and the tables of docs/accuracy.md."""

import json
import math
from collections import Counter

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from curvireg_torch import Registrar
from curvireg_torch.data import BOPDataset
from curvireg_torch.evaluation import BOPBenchmark, Pascal3DBenchmark, Protocol
from curvireg_torch.registration import AnswerSet, ranking_evidence, rescoring
from tests._support.real_data import real_data
from tests._support.scenes import CAMERA, scene, truck_bank

pytest.importorskip("sklearn", reason="scikit-learn is not installed")
from scripts.calibration import answer_sets, calibrate, quality, refinement

MODEL = "contours, exact, appearance"


def row(number, *, right=True, form="exact", kind=None, wrong=None, lead=3.0, similarity=0.7, **more):
    """A photograph with two hypotheses; the better one leads by ``lead`` in the final score."""
    names = ("rank", "similarity", "edge_support", "appearance")
    evidence = [(lead, similarity, 0.4, lead / 2), (0.0, similarity, 0.4, 0.0)]
    error, mesh, ranking = 5.0 if right else 90.0, f"mesh {number}", [similarity, lead, 0.5]
    known = {"id": number, "form": form, "pose": "upright", "kind": kind, "like": mesh, "mesh": mesh, "wrong": wrong}
    known |= {"clutter": 3, "errors": [error, 120.0], "view_errors": [error], "ranking": ranking}
    known["evidence"] = [dict(zip(names, one, strict=True)) for one in evidence]
    unrefined = {name: known[name] for name in ("errors", "evidence", "ranking")}
    return known | {"unrefined": {"appearance": unrefined, "no appearance": unrefined}} | more


def logistic_rows(count, seed=0):
    """Rows whose lead determines how likely they are right: P = 1 / (1 + exp(-lead))."""
    rng = np.random.default_rng(seed)
    leads = rng.uniform(-3, 3, count).tolist()
    return [row(k, right=bool(rng.random() < 1 / (1 + math.exp(-lead))), lead=lead) for k, lead in enumerate(leads)]


def test_folds_of_keeps_objects_copies_and_kinds_together():
    rows = [row(k, kind=("chair", "car", None)[k % 3], like=f"mesh {k % 20}") for k in range(120)]
    folds, groups = calibrate.folds_of(rows).tolist(), [quality.group_of(r) for r in rows]
    assert len(set(folds)) == calibrate.FOLDS
    assert len(set(zip(folds, groups, strict=True))) == len(set(groups))


def test_fit_confidence_recovers_the_probability():
    """The features that matter are the lead (3 times its weight in the score) and half of it as appearance."""
    rows = logistic_rows(3000)
    model, used, confidence, right = calibrate.fit_confidence(rows, MODEL)
    assert len(used) == len(rows)
    logits = [math.log(p / (1 - p)) for p in confidence]
    leads = [r["evidence"][0]["rank"] for r in rows]
    assert np.polyfit(leads, logits, 1) == pytest.approx([1.0, 0.0], abs=0.15)
    assert model(calibrate.features_of(rows[0])[0]) == pytest.approx(confidence[0], abs=0.05)
    assert quality.auc(confidence, right) > 0.8


def test_fit_confidence_gives_wrong_meshes_a_tenth_of_the_weight():
    assert not calibrate.is_right(row(0, wrong="any"), 5.0)
    assert calibrate.is_right(row(0, wrong="kind"), 5.0)
    assert not calibrate.is_right(row(0), 31.0)
    rows = [row(k, right=True, lead=1.0) for k in range(500)]
    rows += [row(1000 + k, right=False, wrong="any", lead=1.0) for k in range(50)]
    _, _, confidence, _ = calibrate.fit_confidence(rows, MODEL)
    assert confidence == pytest.approx(np.full(550, 0.9), abs=0.02)


def test_fit_transfer_scales_the_weights():
    exact = calibrate.LogisticModel({"lead": 2.0, "edge_support": -1.0}, 0.5)
    rng = np.random.default_rng(1)
    X = rng.uniform(-2, 2, (4000, 2))
    logit = 0.25 * (2.0 * X[:, 0] - X[:, 1]) - 0.8
    y = rng.random(4000) < 1 / (1 + np.exp(-logit))
    found = calibrate.fit_transfer(exact, X, y)
    assert found.weights["lead"] == pytest.approx(0.5, abs=0.06)
    assert found.weights["edge_support"] == pytest.approx(-0.25, abs=0.03)
    assert found.bias == pytest.approx(-0.8, abs=0.1)
    assert set(calibrate.fit_transfer(exact, X, ~y).weights.values()) <= {0.0, -0.0}, "the factor is never negative"


def test_fit_rescoring_follows_the_right_hypotheses():
    """Only edge support separates right from wrong here: its weight grows from the one in use."""
    names = calibrate.POSE_FEATURES
    evidence = [(0.0, 0.6, 0.1, 0.0), (-1.0, 0.5, 0.4, 0.0)]
    wrong_first = {"errors": [90.0, 5.0], "evidence": [dict(zip(names, e, strict=True)) for e in evidence]}
    found = dict(zip(names, calibrate.fit_rescoring([{**row(k), **wrong_first} for k in range(50)]), strict=True))
    assert found["edge_support"] > 10.0
    assert found["rank"] < 1.0


def test_fit_covariance_ellipsoids_contain_their_levels():
    """Errors of Student's t distribution have much heavier tails than a Gaussian's."""
    rng = np.random.default_rng(2)
    C = np.diag([1e-4] * 3 + [4e-4] * 3)
    errors = rng.standard_normal((2000, 6)) * np.sqrt(np.diag(C)) / np.sqrt(rng.chisquare(2, (2000, 1)) / 2)
    more = {"covariance": (7.0 * C).tolist(), "scale": 7.0, "distance": 3.0}
    rows = [row(k, pose_error=e.tolist(), **more) for k, e in enumerate(errors)]
    constants, found = calibrate.fit_covariance(rows, np.full(2000, 0.95))
    assert found["n"] == 2000
    assert [k / 2000 for k in found["inside"].values()] == pytest.approx([0.5, 0.9, 0.95], abs=0.02)
    assert constants["squared_radius"]["0.9"] == pytest.approx(chi2.ppf(0.9, 6), rel=1e-3)
    squares = np.array([quality.squared_distance(e, constants["scale"] * C, 3.0) for e in errors])
    inside = quality.count_inside(squares, constants["squared_radius"])
    assert inside["0.9"] / 2000 == pytest.approx(0.9, abs=0.01)
    _, found = calibrate.fit_covariance(rows[:1000], np.where(np.arange(1000) < 600, 0.95, 0.5))
    assert found["n"] == 600, "only reliable results count"


def test_squared_distance_ignores_unknown_directions():
    C = np.diag([1e-4, 1e-4, math.pi**2, 1e-4, 1e-4, 1e-4])
    assert quality.squared_distance([0.01, 0.0, 3.0, 0.0, 0.0, 0.02], C, 2.0) == pytest.approx(1.0 + 4.0)


def test_quality_of_known_confidences():
    assert quality.auc(np.array([0.5, 0.9, 0.5, 0.1]), np.array([True, True, False, False])) == pytest.approx(3.5 / 4)
    confidence, right = np.array([0.95, 0.92, 0.6, 0.3]), np.array([True, True, False, True])
    found = quality.quality(confidence, right, [0, 1, 2, 3])
    assert found["auc"] == pytest.approx(2 / 3)
    assert found["coverage_at_risk"] == 0.5
    assert found["risk_at_coverage"] == {"1": [1, 4], "0.75": [1, 3], "0.5": [0, 2], "0.25": [0, 1]}
    assert (found["reliable"], found["reliable_and_right"]) == (2, 2)
    none = quality.quality(np.array([0.1, 0.2]), np.array([True, True]), [0, 0])
    assert (none["auc"], none["auc_interval"], none["reliable"]) == (None, None, 0)
    assert none["coverage_interval"] is None, "a single unit has no variation"


@pytest.mark.parametrize("members", [1, 5])
def test_interval_matches_the_binomial_of_the_units(members):
    """Independent oracle: the normal approximation. Copies of a photograph do not narrow the interval."""
    values = (torch.arange(400) % 4 == 0).float().repeat(members)
    mean, low, high = quality.interval(values, [f"unit {k % 400}" for k in range(400 * members)])
    assert mean == 0.25
    half = 1.96 * (0.25 * 0.75 / 400) ** 0.5
    assert [low, high] == pytest.approx([mean - half, mean + half], abs=0.006)


def test_interval_weights_units_by_their_members():
    """A hundred units of nine right members each, and a hundred units of one wrong member."""
    units = [k // 9 for k in range(900)] + list(range(100, 200))
    mean, low, high = quality.interval([1.0] * 900 + [0.0] * 100, units)
    assert mean == 0.9
    assert 0.85 < low < 0.9 < high < 0.93
    right = np.repeat([True, False, True, True], 25)
    assert quality.interval_of(np.repeat(range(4), 25), lambda i: right[i].mean()) == (0.25, 1.0)


def test_independent_units_of_both_formats(pascal, bop):
    """PASCAL3D+: objects of one CAD model. BOP: an object of a scene in one pose under all lightings."""
    benchmark = Pascal3DBenchmark(pascal, Protocol())
    meshes = [item.meshes for item in benchmark.items]
    units = quality.independent_units(benchmark)
    assert [units[i] == units[k] for i in range(5) for k in range(5)] == [a == b for a in meshes for b in meshes]
    for name in ("scene_gt", "scene_gt_info", "scene_camera"):
        path = bop.root / "test" / "000001" / f"{name}.json"
        content = json.loads(path.read_text())
        path.write_text(json.dumps({"0": content["0"], "3": content["0"]}))
    benchmark = BOPBenchmark(BOPDataset(bop.root, targets=False), Protocol(pose="any"))
    assert [i.key for i in benchmark.items] == ["1/0/0", "1/0/1", "1/0/2", "1/3/0", "1/3/1", "1/3/2", "2/7/0"]
    assert quality.independent_units(benchmark) == [0, 1, 2, 0, 1, 2, 3]


def test_independent_units_of_hope_are_views_in_five_lightings():
    objects = BOPBenchmark(BOPDataset(real_data("bop/hope")), Protocol(pose="any"))
    counts = Counter(quality.independent_units(objects))
    assert (len(counts), set(counts.values())) == (16, {5})


def test_exactness_is_that_of_right_answers_with_the_exact_mesh():
    rows = [
        row(k, right=k < 3)
        | {"errors": [e], "view_errors": [6.0 * e], "pose_error": [9, 9, 9, 0, 3 * e, 4 * e], "distance": 100.0}
        for k, e in enumerate((1.0, 2.0, 3.0, 40.0))
    ]
    rows += [{**rows[0], "errors": [29.0], "form": "sibling"}, {**rows[0], "errors": [29.0], "wrong": "any"}]
    (found,) = quality.exactness(rows).values()
    assert found == pytest.approx(
        {
            "n": 3,
            "best view": 12.0,
            "rotation median": 2.0,
            "rotation 90 %": 2.8,
            "translation median": 0.1,
            "translation 90 %": 0.14,
        }
    )


def test_page_has_a_line_for_each_model_and_set():
    rows = logistic_rows(300) + [row(400 + k, form="sibling", kind="chair", right=k % 2 == 0) for k in range(40)]
    rows += [row(500 + k, form="sibling", kind="car", right=k % 3 == 0) for k in range(40)]
    for r in rows[:300]:
        r |= {"pose_error": [0.01] * 6, "covariance": np.diag([1e-4] * 6).tolist(), "scale": 1.0, "distance": 2.0}
    constants, found = calibrate.calibrate(rows)
    record = {
        "date": "today",
        "commit": "abc",
        "registered": "def",
        **constants,
        **found,
        "shares": quality.success_rates(rows),
    }
    covariance = {"n": 2, "inside": {"0.5": 1, "0.9": 1, "0.95": 2}}
    record["real"] = {"lm": {**found["held_out"]["ranking, exact, appearance"], "covariance": covariance}}
    text = quality.page(record)
    assert constants["confidence"].keys() == calibrate.MODELS.keys()
    for name in (*calibrate.MODELS, f"{MODEL}, in clutter", "lm"):
        assert f"\n| {name} | " in text
    assert "| lm | 2 | 1 (0.50) | 1 (0.50) | 2 (1.00) |" in text
    assert "| exact upright | 300 |" in text


@pytest.mark.parametrize("camera", [CAMERA, None])
def test_features_of_match_the_registration(camera, monkeypatch):
    """Also where the final pose does not come from the best-ranked view."""
    monkeypatch.setattr(rescoring, "WEIGHTS", (-1.0, *rescoring.WEIGHTS[1:]))  # prefers the view that ranks last
    monkeypatch.setattr(rescoring, "RANK_ALONE", (-1.0, 0.0, 0.0, 0.0))
    image, box, _ = scene(0)
    result = Registrar(truck_bank())([image], box[None], camera)[0]
    assert int(result.candidates[0]) != int(result.ranking.order[0, 0])
    stored = {"form": "sibling" if camera is None else "exact", "errors": [0.0]}
    stored["evidence"] = [dict(h.evidence) for h in result.hypotheses]
    stored["ranking"] = ranking_evidence(result.ranking, truck_bank().rotations)[0].tolist()
    assert calibrate.features_of(stored)[0] == pytest.approx(result.confidence_features)


def test_fit_answers_recovers_the_probabilities_of_rivals():
    """Where the first of three answers is wrong, the rivals are right in proportion to exp(0.5 lead), none to e."""
    rng = np.random.default_rng(0)
    cases = []
    for lead in rng.uniform(0, 4, 3000):
        logits = np.array([0.0, -0.5 * lead, 1.0])
        p = np.exp(logits) / np.exp(logits).sum()
        right = np.zeros(4, dtype=bool)
        right[1 + rng.choice(3, p=p)] = True
        cases.append((torch.tensor([9.0, lead, 0.0]), right))
    constants = answer_sets.fit_answers(cases)
    assert constants["slope"] == pytest.approx(0.5, abs=0.06)
    assert constants["none"] == pytest.approx(1.0, abs=0.1)


def test_fit_answer_sets_covers_nine_of_ten_held_out_photographs():
    rows = logistic_rows(2000)
    _, used, confidence, _ = calibrate.fit_confidence(rows, MODEL)
    fold = calibrate.folds_of(used)
    constants, found = answer_sets.fit_answer_sets(used, MODEL, confidence, fold)
    assert found["n"] == 2000
    assert found["coverage"] == pytest.approx(0.9, abs=0.03)
    assert 1.0 <= found["mean_size"] <= 3.0
    assert 0.0 < constants["threshold"] <= 1.0


def test_probability_before_the_first_right_answer():
    answers = AnswerSet((0.5, 0.12, 0.3))
    for right, before in {0: 0.0, 2: 0.5, 1: 0.8, 3: 0.92}.items():
        assert answer_sets.probability_before(answers, np.arange(4) == right) == pytest.approx(before)


def test_basin_counts_refined_poses_and_those_of_rapid():
    near = {"lost": False, "rotation_error": 3.0, "position_error": 0.01}
    exact = {"lost": False, "rotation_error": 1.0, "position_error": 0.01}
    assert refinement.fractions_right([exact, near, {"lost": True}, {**exact, "position_error": 0.1}]) == {
        "n": 4,
        "within 2 degrees and 2 %": 0.25,
        "within 5 degrees and 5 %": 0.5,
    }


def test_basin_page_has_the_recorded_table():
    record = json.loads((calibrate.REPOSITORY / "scripts/results/refinement_basin.json").read_text())
    page = (calibrate.REPOSITORY / "docs/guides/known-pose.md").read_text(encoding="utf-8")
    assert f"<!-- refinement:begin -->\n{refinement.page_table(record)}<!-- refinement:end -->" in page
    for row in record["basin"].values():
        row["cv2.rapid"] = {**row, "within 5 degrees and 5 %": 0.123}
    lines = refinement.page_table(record).splitlines()
    assert lines[0].endswith("| `cv2.rapid`: within 5 degrees and 5 % |")
    assert lines[2].endswith("| 0.12 |")
