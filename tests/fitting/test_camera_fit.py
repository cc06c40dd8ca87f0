"""Least squares over poses and cameras."""

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch import camera_matrix
from curvireg_torch.fitting import camera_fit
from curvireg_torch.fitting.contour_problem import ContourProblem
from curvireg_torch.fitting.edges import EdgeField
from curvireg_torch.fitting.least_squares import PointMatches, apply_twist, pixels, project
from curvireg_torch.fitting.measured_fit import FULL_SIZE_RADII
from curvireg_torch.geometry import rotation_error
from curvireg_torch.geometry.cameras import projected
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from tests._support import SIZE, double, scene, seeded, truck_registrar
from tests.fitting.cube import crops_of

NEAR = camera_matrix(150.0, 150.0, 119.5, 89.5)  # a wide angle, from where perspective is strong


def near_scene():
    """image, box and true pose of the object of scene 0, at a distance of three radii."""
    T = scene(0)[2].clone()
    describer = truck_registrar().describer
    ahead = double([0.0, 0.0, 3.0 * describer.radius])
    T[:3, 3] = ahead - T[:3, :3] @ describer.centre
    image, box = synthesize_photograph(example_mesh(), T, NEAR, SIZE, seeded(5))
    return image, box, T


def near_problem(wrong=1.0):
    """Of a focal length that is wrong by this factor; and the true pose (1, 4, 4)."""
    image, box, T = near_scene()
    K = camera_fit.scaled_cameras(NEAR[None], double([wrong]).log())
    contours = truck_registrar().describer.contours
    return ContourProblem.of(contours, crops_of(image, box), K), T[None]


def fit(problem, T, prior, matches=None):
    return camera_fit.fit_camera(problem, T, prior, FULL_SIZE_RADII, matches)


def prior_within(limit, deviation, powers=camera_fit.FOCAL_LENGTH):
    """Around the camera of the start."""
    none = double([0.0])
    return camera_fit.CameraPrior(none, deviation, none - limit, none + limit, powers=powers)


@pytest.mark.parametrize(
    ("powers", "fx", "fy"),
    [
        (camera_fit.FOCAL_LENGTH, 150.0 * math.exp(0.01), 150.0 * math.exp(0.01)),
        (camera_fit.ASPECT, 150.0 * math.exp(0.005), 150.0 * math.exp(-0.005)),
    ],
    ids=["focal length", "aspect"],
)
def test_another_camera_keeps_the_place_of_the_image(powers, fx, fy):
    T = scene(0)[2][None].clone()
    centre = truck_registrar().describer.centre
    T[0, 0, 3] += 0.3  # off the axis
    factor = double([0.01])
    moved = camera_fit.kept_in_place(T, factor, centre, powers)
    other = camera_fit.scaled_cameras(NEAR[None].double(), factor, powers)
    assert_close(other[0], double([[fx, 0.0, 119.5], [0.0, fy, 89.5], [0.0, 0.0, 1.0]]))
    before, after = (
        projected(centre[None], pose, K)[0]
        for pose, K in ((T, NEAR[None].double()), (moved, other))
    )
    assert_close(before, after)
    motion = 0.01 * camera_fit._motion_with_camera(T, centre, powers)
    assert_close(apply_twist(T, motion, centre), moved, atol=1e-4, rtol=0.0)
    assert motion[0, :3].norm() > 5e-4


@pytest.mark.parametrize("powers", [camera_fit.FOCAL_LENGTH, camera_fit.ASPECT])
def test_derivative_by_the_camera(powers):
    problem, T = near_problem()
    T = apply_twist(T, double([[0.05, 0.1, 0.0, 0.02, 0.0, 0.0]]), problem.centre)
    state = problem.state(T)
    step = double([1e-5])

    def pixels(sign):
        moved = camera_fit.kept_in_place(T, sign * step, problem.centre, powers)
        K = camera_fit.scaled_cameras(problem.K, sign * step, powers)
        return project(state.points.model, state.points.normals, moved, K, problem.centre)[0]

    numeric = ((pixels(1.0) - pixels(-1.0)) / (2.0 * step) * state.points.normals).sum(dim=-1)
    valid = state.points.valid
    found = camera_fit._projected(problem, T, state.points, powers)[1][..., 6]
    assert_close(found[valid], numeric[valid], atol=1e-4, rtol=1e-4)
    assert found[valid].abs().max() > 1.0


def test_contours_show_by_how_much_a_photograph_is_stretched():
    """By as much more as it is stretched more, and within two deviations."""
    problem, T = near_problem()
    prior = prior_within(2.0, 1e3, camera_fit.ASPECT)
    shown = []
    for stretch in (0.94, 1.06):
        gap = double([stretch]).log()
        wrong = replace(problem, K=camera_fit.scaled_cameras(problem.K, -gap, camera_fit.ASPECT))
        start = camera_fit.kept_in_place(T, -gap, problem.centre, camera_fit.ASPECT)
        found = fit(wrong, start, prior)
        information, _ = camera_fit.camera_information(
            found.problem, found.state, 2.0, None, camera_fit.ASPECT
        )
        deviation = float(information.variance.sqrt())
        assert deviation < 0.05
        assert float(found.log_factor) == pytest.approx(float(gap), abs=2.0 * deviation)
        assert rotation_error(found.state.T[0, :3, :3], T[0, :3, :3]) < 1.5
        shown.append(float(found.log_factor))
    assert shown[1] - shown[0] == pytest.approx(math.log(1.06 / 0.94), abs=0.005)


@pytest.mark.parametrize("wrong", [0.75, 1.35])
def test_strong_perspective_shows_the_focal_length(wrong):
    problem, T = near_problem(wrong)
    start = camera_fit.kept_in_place(T, double([wrong]).log(), problem.centre)
    found = fit(problem, start, camera_fit.CameraPrior.usual(wrong * NEAR[None].double(), SIZE))
    assert wrong * float(found.log_factor.exp()) == pytest.approx(1.0, abs=0.06)
    assert rotation_error(found.state.T[0, :3, :3], T[0, :3, :3]) < 1.5
    information, _ = camera_fit.camera_information(found.problem, found.state, 2.0)
    assert information.variance.sqrt() < 0.2


@pytest.mark.parametrize("wrong", [0.75, 1.35])
def test_points_of_the_surface_show_the_focal_length_without_edges(wrong):
    problem, T = near_problem(wrong)
    blank = EdgeField(torch.full((1, 3, 256, 256), 0.5))
    problem = replace(problem, edges=blank, mask=None)
    K = camera_fit.scaled_cameras(problem.K, -double([wrong]).log())
    model = problem.state(T).points.model[:, ::10]
    uv = pixels(model, T, K)
    matches = PointMatches(model, uv, torch.ones(uv.shape[:2], dtype=torch.float64))
    start = camera_fit.kept_in_place(T, double([wrong]).log(), problem.centre)
    prior = prior_within(2.0, 1e3)
    found = fit(problem, start, prior, matches)
    assert wrong * float(found.log_factor.exp()) == pytest.approx(1.0, abs=2e-3)
    assert rotation_error(found.state.T[0, :3, :3], T[0, :3, :3]) < 0.1
    exact, _ = camera_fit.camera_information(found.problem, found.state, 2.0, matches)
    assert 0.0 < exact.variance.sqrt() < 0.1
    assert abs(float(exact.step)) < 2e-3
    half = camera_fit.camera_information(found.problem, found.state, 2.0, matches.scaled(0.5))[0]
    assert float(half.amount) == pytest.approx(0.5 * float(exact.amount), rel=1e-3)
    uv[:, ::4] += 12.0  # wrong matches, beyond the scale of the weights
    robust = fit(problem, start, prior, replace(matches, uv=uv))
    assert float(robust.log_factor) == pytest.approx(float(found.log_factor), abs=0.01)


@pytest.mark.parametrize(
    ("deviation", "limit", "is_moved", "expected"),
    [
        (1e-4, 1.0, False, pytest.approx(0.0, abs=1e-3)),
        (0.5, 0.05, True, pytest.approx(-0.05, abs=1e-9)),
    ],
)
def test_a_narrow_prior_or_a_limit_holds_the_focal_length(deviation, limit, is_moved, expected):
    problem, T = near_problem(1.35)
    start = camera_fit.kept_in_place(T, double([1.35]).log(), problem.centre) if is_moved else T
    assert float(fit(problem, start, prior_within(limit, deviation)).log_factor) == expected


def test_the_pull_of_a_prior_does_not_grow_beyond_its_reach():
    """A prior far away pulls as far as one at its reach."""
    problem, T = near_problem()
    gap = double([2.0])
    wide = gap + 5.0

    def zoom(**changes):
        prior = replace(camera_fit.CameraPrior(gap, 0.2, -wide, wide, 0.05), **changes)
        return float(fit(problem, T, prior).log_factor)

    bounded = zoom()
    assert 0.0 < bounded < 0.5 * zoom(reach=float("inf"))
    # the pull is the same from anywhere; with twice the deviation, a quarter of it
    assert zoom(log_factor=3.0 * gap) == pytest.approx(bounded, abs=0.01)
    none = zoom(deviation=1e6)
    assert zoom(deviation=0.4) - none == pytest.approx(0.25 * (bounded - none), rel=0.35)


def test_a_focal_length_moves_by_steps():
    """Of a quarter of log f, whatever pulls: six in three rounds."""
    problem, T = near_problem()
    gap = double([5.0])
    prior = camera_fit.CameraPrior(gap, 1e-3, -2.0 * gap, 2.0 * gap)
    assert 1.0 < float(fit(problem, T, prior).log_factor) <= 1.5 + 1e-9


def test_errors_of_edges_belong_together(monkeypatch):
    """The variance of log f is sixteen times that of independent errors."""
    problem, T = near_problem()
    state = problem.state(T)
    found, _ = camera_fit.camera_information(problem, state, 2.0)
    monkeypatch.setattr(camera_fit, "FOCAL_SCALE", 1.0)
    independent, _ = camera_fit.camera_information(problem, state, 2.0)
    assert float(found.variance / independent.variance) == pytest.approx(16.0)
