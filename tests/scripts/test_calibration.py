"""Fits of the calibration, and what its generated sets show."""

import shutil
from argparse import Namespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

pytest.importorskip("sklearn")

from curvireg_torch.geometry import transform
from curvireg_torch.geometry.framing import outside_fraction
from curvireg_torch.jobs import runner
from curvireg_torch.registration.doubts import MIRROR_DOUBT
from curvireg_torch.synthetic import example_mesh
from scripts.benchmark.make import TWIN, Packages, Shapes, Tied
from scripts.calibration import fits, measure, sets
from scripts.calibration.calibrate import covariance_quality
from scripts.scenes.scene import SIZE, cut, look_at
from tests._support.miniature import write_bop, write_image


def options(**changes):
    return Namespace(**({"seed": 3, "models": 10, "cad": "exact"} | changes))


def test_logistic_fit_recovers_weights_and_respects_signs():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(4000, 3))
    right = rng.random(4000) < 1.0 / (
        1.0 + np.exp(-(2.0 * X[:, 0] - 1.0 * X[:, 1] + 0.5 * X[:, 2] + 0.7))
    )
    rows = [
        {"features": dict(zip("abc", x, strict=True)), "right": y}
        for x, y in zip(X, right, strict=True)
    ]
    free = fits.fit_logistic(rows, np.ones(4000), {})
    assert list(free["weights"].values()) == pytest.approx([2.0, -1.0, 0.5], abs=0.15)
    assert free["bias"] == pytest.approx(0.7, abs=0.15)
    bound = fits.fit_logistic(rows, np.ones(4000), {"a": 1.0, "b": 1.0, "c": -1.0})
    assert bound["weights"]["a"] > 1.0
    assert (bound["weights"]["b"], bound["weights"]["c"]) == (0.0, 0.0)


def test_covariances_are_too_small_by_the_factor_that_is_found():
    """Errors of three times the standard deviations: nine times the scale would be right."""
    errors = 3.0 * np.random.default_rng(0).normal(size=(20_000, 6))
    quality = covariance_quality((errors**2).sum(axis=1), 2.0)
    assert quality["covariances"] == 20_000
    assert quality["covariance_scale"] == pytest.approx(18.0, rel=0.03)
    exact = covariance_quality((errors**2).sum(axis=1) / 9.0, 2.0)
    assert exact["within"] == pytest.approx({"50%": 0.5, "90%": 0.9}, abs=0.02)


def test_shares_fit_recovers_slope_and_resolution():
    """Scores of two poses differ by noise where they are tied, and by more where one is right."""
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(2000):
        behind = rng.uniform(0.0, 3.0)
        logit = -2.0 * max(0.0, behind - 0.5)
        second = rng.random() < np.exp(logit) / (1.0 + np.exp(logit))
        rows.append(
            {
                "scores": [0.0, -behind],
                "errors": [90.0, 1.0] if second else [1.0, 90.0],
                "right": True,
            }
        )
    fitted = fits.fit_shares(rows, np.ones(len(rows)), ties=True)
    assert fitted["slope"] == pytest.approx(2.0, abs=0.5)
    assert fitted["resolution"] == pytest.approx(0.5, abs=0.21)
    assert fits.fit_shares(rows, np.ones(len(rows)), ties=False)["resolution"] == 0.0
    none = fits.fit_shares([], np.ones(0), ties=True)
    assert none["slope"] == pytest.approx(0.0, abs=0.05), "no photograph decides"


def test_sets_of_furniture_are_left_out_where_there_is_none(tmp_path):
    assert "furniture" not in sets.sets_of(["instance"], None)
    assert "furniture" in sets.sets_of(["instance"], tmp_path)
    shared = {name for name, each in sets.SETS.items() if each.share}
    assert shared < set(sets.sets_of(["instance"], None))


def test_rows_are_kept_of_the_same_photographs_and_code_alone(tmp_path, monkeypatch):
    write_bop(tmp_path / "shapes")
    (tmp_path / "shapes" / "test_targets_bop19.json").unlink()
    scenes = tmp_path / "shapes" / "test"
    tasks = []
    monkeypatch.setattr(measure, "measure", lambda task: tasks.append(task) or [task[3]])

    def measured():
        tasks.clear()
        kept = measure.rows_of(tmp_path, "shapes", 1)
        return [task[3] for task in tasks], kept

    upright, one, two = [3], [0, 2], [1]
    assert measured() == ([upright, one, two],) * 2
    assert measured() == ([], [upright, one, two])
    shutil.copytree(scenes / "000001", scenes / "000005")  # of a larger --count
    more = [[0, 2, 4, 6], [1, 5]]
    assert measured() == (more, [upright, *more])
    write_image(scenes / "000002" / "gray" / "000007.png")
    changed = [upright, [1, 5]]  # the photograph beside those of an object counts
    assert measured() == (changed, [upright, *more]), "in the order of the tasks"
    monkeypatch.setattr(runner, "results_digest", lambda: "of other code")
    assert measured()[0] == [upright, *more]


def test_twins_have_the_same_shape_and_another_print():
    twins = Packages(options(cad="print"))
    one = twins.mesh(1)
    other = twins.mesh(1 + TWIN)
    assert np.array_equal(one.triangles, other.triangles)
    assert not np.array_equal(one.paints[0].picture, other.paints[0].picture)
    assert twins.written == [k + TWIN for k in twins.ids]


def test_mirrored_shapes_are_no_rotation_of_the_shape():
    tied = Tied(options(cad="mirrored"))
    one = tied.mesh(2)
    other = tied.mesh(2 + TWIN)
    assert_allclose(other.triangles[:, ::-1] * (-1.0, 1.0, 1.0), one.triangles)


def test_symmetries_of_shapes_keep_their_materials():
    shapes = Shapes(options())
    for obj_id in (1, 2):
        S = shapes.symmetries(obj_id)
        assert_allclose(S[0], np.eye(3))
        assert_allclose(S @ S.transpose(0, 2, 1), np.broadcast_to(np.eye(3), S.shape), atol=1e-9)


@pytest.mark.parametrize("fraction", [0.1, 0.35, 0.6])
def test_cut_puts_a_fraction_of_the_object_outside(fraction):
    rng = np.random.default_rng(4)
    points = Tied(options()).mesh(1).hull
    view = look_at(points, rng, fill=250.0, azimuth=30.0, elevation=20.0)
    R, t, K = cut(view, points, fraction, rng)
    R, t, K, hull = map(torch.from_numpy, (R, t, K, points))
    found = outside_fraction(hull, transform(R, t), K, SIZE)
    assert found == pytest.approx(fraction, abs=0.02)


def test_level_of_few_rows_keeps_the_proportions_of_the_weights():
    generator = np.random.default_rng(0)
    constants = {"weights": {"a": 2.0, "b": -1.0}, "bias": 0.5, "slope": 1.5, "resolution": 0.5}
    rows = []
    for a, b in generator.normal(size=(4000, 2)):
        logit = 0.5 * (0.5 + 2.0 * a - b) - 1.0  # half as sure as the model says, and lower
        share = 1.0 / (1.0 + np.exp(-1.5 * (1.0 - 0.5)))  # of two scores, a point apart
        first = bool(generator.random() < share / (1.0 + np.exp(-logit)))
        rows.append({"features": {"a": a, "b": b}, "scores": [3.0, 2.0], "first": first})
    fitted = fits.fit_level(rows, np.ones(len(rows)), constants)
    assert fitted["weights"]["a"] == pytest.approx(1.0, abs=0.15)
    assert fitted["weights"]["b"] == pytest.approx(-0.5, abs=0.08)
    assert fitted["bias"] == pytest.approx(0.25 - 1.0, abs=0.15)
    assert (fitted["slope"], fitted["resolution"]) == (1.5, 0.5)


def test_registrations_that_fit_worse_than_the_mirror_image_are_doubted():
    rng = np.random.default_rng(0)
    rows = []
    for k in range(120):
        known = float(rng.normal())
        is_right = known + 0.3 * rng.normal() > 0.0
        rows.append(
            {
                "group": f"group {k % 12}",
                "set": "mirrored" if k % 10 == 0 else "shapes",
                "grey": k % 3 == 0,
                "mirror": k % 10 == 0,
                "features": {"known": known},
                "scores": [2.0, 1.0],
                "errors": [5.0, 90.0] if is_right else [90.0, 120.0],
            }
        )
    constants, quality = fits.fit_registrations(rows, exact=True)
    assert constants["n"] == 108, "of a mirrored one the fit learns nothing"
    assert quality["sets"]["shapes"]["auc"] > 0.9
    assert quality["sets"]["mirrored"]["right"] == 0.0, "the photographs do not show the mesh"
    plain = rows[1] | {"mirror": False}
    doubted = rows[1] | {"mirror": True}
    probability = fits.first_probability(plain, constants)
    assert fits.first_probability(doubted, constants) == pytest.approx(MIRROR_DOUBT * probability)


def test_grey_meshes_have_no_colours(tmp_path):
    path = tmp_path / "painted.glb"
    example_mesh(painted=True).apply_scale(1000.0).export(path)  # in mm
    assert measure.mesh_of(path, grey=False).has_colours
    assert not measure.mesh_of(path, grey=True).has_colours
    assert measure.is_grey("shelves", 4)
    assert not measure.is_grey("shelves", 3)
    assert not measure.is_grey("wrong", 4)
