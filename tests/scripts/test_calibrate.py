"""scripts/calibration/calibrate.py: what is fitted, on what, and what it is said to be worth."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from curvireg_torch import Registrar
from curvireg_torch.registration import ranking_evidence, rescoring
from tests._support.scenes import CAMERA, scene, truck_bank
from tests._support.scripts import imported


@pytest.fixture(scope="module")
def script():
    pytest.importorskip("sklearn", reason="scikit-learn is not installed")
    with imported("scripts.calibration.calibrate") as module:
        yield module


def row(number, *, right=True, form="exact", kind=None, wrong=None, lead=3.0, similarity=0.7, **more):
    """A photograph of two hypotheses, the better of which leads by ``lead`` in the verdict."""
    names = ("rank", "similarity", "edge_support", "appearance")
    evidence = [(lead, similarity, 0.4, lead / 2), (0.0, similarity, 0.4, 0.0)]
    return {
        "id": number,
        "form": form,
        "pose": "upright",
        "kind": kind,
        "like": f"mesh {number}",
        "mesh": f"mesh {number}",
        "wrong": wrong,
        "clutter": 3,
        "errors": [5.0 if right else 90.0, 120.0],
        "view_errors": [5.0 if right else 90.0],
        "evidence": [dict(zip(names, one, strict=True)) for one in evidence],
        "ranking": [similarity, lead, 0.5],
        "fast": {"ranking": [similarity, lead, 0.5], "error": 5.0 if right else 90.0},
        **more,
    }


def rows_of_two_kinds(count, seed=0):
    """Leads that say how likely an answer is right: P = 1 / (1 + exp(-lead))."""
    rng = np.random.default_rng(seed)
    leads = rng.uniform(-3, 3, count)
    return [
        row(k, right=bool(rng.random() < 1 / (1 + math.exp(-lead))), lead=float(lead)) for k, lead in enumerate(leads)
    ]


def test_objects_copies_and_kinds_stay_in_one_fold(script):
    rows = [row(k, kind=("chair", "car", None)[k % 3], like=f"mesh {k % 20}") for k in range(120)]
    folds = script.folds_of(rows)
    assert len(set(folds)) == script.FOLDS
    for group in {script.group_of(r) for r in rows}:
        assert len({f for f, r in zip(folds, rows, strict=True) if script.group_of(r) == group}) == 1
    assert len({f for f, r in zip(folds, rows, strict=True) if r["kind"] == "chair"}) == 1


def test_a_model_finds_how_sure_answers_are(script):
    """The features that count here are the lead (3 times its weight in the verdict) and half of it as appearance."""
    rows = rows_of_two_kinds(3000)
    model, used, sure, right = script.fit_confidence(rows, "contours, camera, appearance")
    assert len(used) == len(rows)
    logits = [math.log(p / (1 - p)) for p in sure]
    leads = [r["evidence"][0]["rank"] for r in rows]
    assert np.polyfit(leads, logits, 1) == pytest.approx([1.0, 0.0], abs=0.15)
    assert model(script.features_of(rows[0])[0]) == pytest.approx(sure[0], abs=0.05)
    assert script.auc(sure, right) > 0.8


def test_another_objects_mesh_keeps_the_weights_and_learns_what_they_are_worth(script):
    own = script.LogisticModel({"lead": 2.0, "edge_support": -1.0}, 0.5)
    rng = np.random.default_rng(1)
    X = rng.uniform(-2, 2, (4000, 2))
    logit = 0.25 * (2.0 * X[:, 0] - X[:, 1]) - 0.8
    y = rng.random(4000) < 1 / (1 + np.exp(-logit))
    found = script.transferred(own, X, y)
    assert found.weights["lead"] == pytest.approx(0.5, abs=0.06)
    assert found.weights["edge_support"] == pytest.approx(-0.25, abs=0.03)
    assert found.bias == pytest.approx(-0.8, abs=0.1)
    assert set(script.transferred(own, X, ~y).weights.values()) <= {0.0, -0.0}, "never the other way round"


def test_wrong_meshes_are_wrong_and_weigh_a_tenth(script):
    assert not script.is_right(row(0, wrong="any"), 5.0)
    assert script.is_right(row(0, wrong="kind"), 5.0)
    assert not script.is_right(row(0), 31.0)
    rows = [row(k, right=True, lead=1.0) for k in range(500)]
    rows += [row(1000 + k, right=False, wrong="any", lead=1.0) for k in range(50)]
    _, _, sure, _ = script.fit_confidence(rows, "contours, camera, appearance")
    assert sure == pytest.approx(np.full(550, 0.9), abs=0.02)


def test_what_confidences_are_worth(script):
    assert script.auc(np.array([0.5, 0.9, 0.5, 0.1]), np.array([True, True, False, False])) == pytest.approx(3.5 / 4)
    sure, right = np.array([0.95, 0.92, 0.6, 0.3]), np.array([True, True, False, True])
    found = script.worth(sure, right, [0, 1, 2, 3])
    assert found["auc"] == pytest.approx(2 / 3)
    assert found["coverage_at_risk"] == 0.5
    assert found["risk_at_coverage"] == {"1": [1, 4], "0.75": [1, 3], "0.5": [0, 2], "0.25": [0, 1]}
    assert (found["reliable"], found["reliable_and_right"]) == (2, 2)
    none = script.worth(np.array([0.1, 0.2]), np.array([True, True]), [0, 0])
    assert (none["auc"], none["auc_interval"], none["reliable"]) == (None, None, 0)
    assert none["coverage_interval"] is None, "one unit: nothing to vary"


def test_intervals_are_over_units(script):
    right = np.repeat([True, False, True, True], 25)
    low, high = script.interval_of(np.repeat(range(4), 25), lambda i: right[i].mean())
    assert (low, high) == (0.25, 1.0)


def test_ellipsoids_hold_what_they_say(script):
    """Errors of a Student's t: far heavier tails than a Gaussian's, and yet each level holds its share."""
    rng = np.random.default_rng(2)
    C = np.diag([1e-4] * 3 + [4e-4] * 3)
    errors = rng.standard_normal((2000, 6)) * np.sqrt(np.diag(C)) / np.sqrt(rng.chisquare(2, (2000, 1)) / 2)
    more = {"covariance": (7.0 * C).tolist(), "scale": 7.0, "distance": 3.0}
    rows = [row(k, pose_error=e.tolist(), **more) for k, e in enumerate(errors)]
    constants, found = script.fit_covariance(rows, np.full(2000, 0.95))
    assert found["n"] == 2000
    assert [found["inside"][level] / 2000 for level in ("0.5", "0.9", "0.95")] == pytest.approx(
        [0.5, 0.9, 0.95], abs=0.02
    )
    assert constants["squared_radius"]["0.95"] == pytest.approx(chi2.ppf(0.95, 6), rel=1e-3)
    squares = [script.squared_distance(e, constants["scale"] * C, 3.0) for e in errors]
    assert script.held(np.array(squares), constants["squared_radius"])["0.9"] / 2000 == pytest.approx(0.9, abs=0.01)
    _, none = script.fit_covariance(rows[:1000], np.where(np.arange(1000) < 600, 0.95, 0.5))
    assert none["n"] == 600, "only what is believed"


def test_unknown_directions_do_not_count(script):
    C = np.diag([1e-4, 1e-4, math.pi**2, 1e-4, 1e-4, 1e-4])
    assert script.squared_distance([0.01, 0.0, 3.0, 0.0, 0.0, 0.02], C, 2.0) == pytest.approx(1.0 + 4.0)


def test_the_page_has_a_line_for_each_model_and_set(script):
    rows = rows_of_two_kinds(300) + [row(400 + k, form="sibling", kind="chair", right=k % 2 == 0) for k in range(40)]
    rows += [row(500 + k, form="sibling", kind="car", right=k % 3 == 0) for k in range(40)]
    for r in rows[:300]:
        r |= {"pose_error": [0.01] * 6, "covariance": np.diag([1e-4] * 6).tolist(), "scale": 1.0, "distance": 2.0}
    constants, worth = script.calibrate(rows)
    record = {"date": "today", "commit": "abc", **constants, **worth, "shares": script.shares(rows)}
    record["real"] = {
        "lm": {
            **worth["held_out"]["ranking, appearance"],
            "covariance": {"n": 2, "inside": {"0.5": 1, "0.9": 1, "0.95": 2}},
        }
    }
    text = script.page(record)
    assert constants["confidence"].keys() == script.MODELS.keys()
    for name in (*script.MODELS, "contours, camera, appearance, in clutter", "lm"):
        assert f"\n| {name} | " in text
    assert "| lm | 2 | 1 (0.50) | 1 (0.50) | 2 (1.00) |" in text
    assert "| exact upright | 300 |" in text


def test_weights_of_the_verdict_follow_what_is_right(script):
    """Support alone is right here: its weight grows from the one in use."""
    names = script.POSE_FEATURES
    wrong_first = [(0.0, 0.6, 0.1, 0.0), (-1.0, 0.5, 0.4, 0.0)]
    rows = [
        {**row(k), "errors": [90.0, 5.0], "evidence": [dict(zip(names, e, strict=True)) for e in wrong_first]}
        for k in range(50)
    ]
    found = dict(zip(names, script.fit_verdict(rows), strict=True))
    assert found["edge_support"] > 10.0
    assert found["rank"] < 1.0


@pytest.mark.parametrize("camera", [CAMERA, None])
def test_features_of_a_row_are_those_of_the_registration(script, camera, monkeypatch):
    """Also where the answer comes from another view than the ranking's best."""
    weights = (-1.0, 5.0, 10.0, 1.0)  # the view that ranks last is preferred
    monkeypatch.setattr(rescoring, "WEIGHTS", weights)
    monkeypatch.setattr(rescoring, "RANK_ALONE", (-1.0, 0.0, 0.0, 0.0))
    image, box, _ = scene(0)
    result = Registrar(truck_bank())([image], box[None], camera)[0]
    assert int(result.candidates[0]) != int(result.ranking.order[0, 0])
    kept = {
        "form": "sibling" if camera is None else "exact",
        "evidence": [dict(h.evidence) for h in result.hypotheses],
        "ranking": ranking_evidence(result.ranking, truck_bank().rotations)[0].tolist(),
        "errors": [0.0],
    }
    assert script.features_of(kept)[0] == pytest.approx(result.confidence_features)
