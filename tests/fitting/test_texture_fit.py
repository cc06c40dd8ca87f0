"""Texture fit: a label determines the rotation of a can, and a pose without the label in the
photograph stays."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.fitting.contour_problem import ContourProblem
from curvireg_torch.fitting.least_squares import apply_twist
from curvireg_torch.fitting.texture_fit import (
    CONVINCING_RATIO,
    _TextureRounds,
    fit_texture,
    match_patches,
    rotated_starts,
    texture_matches,
)
from curvireg_torch.geometry import rotation_error
from curvireg_torch.geometry.cameras import projected_boxes, transform
from curvireg_torch.geometry.viewpoint import rotation_from_viewpoint, up_rotation
from curvireg_torch.mesh.mesh import extreme_points, mesh_centre
from curvireg_torch.registration import ContourFit, fit_contours
from curvireg_torch.rendering import make_renderer, render_colour
from curvireg_torch.rendering.contours import MeshContours
from tests._support import CAMERA, answer_of, bank_of, double, exact_registrar, slow_after, zeros
from tests._support.cans import can, photograph
from tests.fitting.cube import crops_of, edges_in

MESH = can()
R = rotation_from_viewpoint(*double((17.0, 22.0, 0.0))) @ up_rotation("y")
TRUTH = transform(R[None], double([[0.1, -0.05, 7.0]]))
BOX = projected_boxes(extreme_points(MESH), TRUTH, CAMERA)[0].float()
CENTRE = mesh_centre(MESH)
CONTOURS = MeshContours(MESH)


@pytest.fixture(scope="module")
def renderer():
    return make_renderer(MESH)


def turned_can(degrees):
    """The true pose, turned about the can's axis: its contours are the same."""
    twist = zeros(1, 6)
    twist[0, :3] = float(np.radians(degrees)) * R[:, 1]
    return apply_twist(TRUTH, twist, CENTRE)


def problem_of(renderer, image, drawn):
    """What a fit to a photograph is given; ``drawn`` gets the samples of each picture."""

    def draw(T, K, size, samples):
        drawn.append(samples)
        return render_colour(MESH, T, K, size, renderer=renderer, supersampling=samples)

    crops = crops_of(image, BOX)
    return draw, renderer, ContourProblem.of(CONTOURS, crops, CAMERA[None]), crops.crops[0]


def fit(renderer, image, starts):
    return fit_texture(*problem_of(renderer, image, []), starts)


@pytest.mark.parametrize(("aside", "is_found"), [(9.0, True), (16.0, False)])
def test_matches_of_a_fitted_pose_lie_within_twelve_pixels(renderer, aside, is_found):
    given = problem_of(renderer, image(), [])
    problem = given[2]
    shift = zeros(1, 6)
    shift[0, 3] = aside * TRUTH[0, 2, 3] / problem.K[0, 0, 0]
    matches = texture_matches(*given, apply_twist(TRUTH, shift, CENTRE))
    right = matches is not None and matches.inlier_ratio(TRUTH, problem.K) > CONVINCING_RATIO
    assert right == is_found


def error(found):
    return float(rotation_error(found.transform[0, :3, :3], R))


@cache
def image():
    return photograph(MESH, TRUTH)


@pytest.mark.parametrize("degrees", slow_after(2, [-12.0, 5.0, -5.0, 12.0]))
def test_label_determines_the_rotation_about_the_axis(renderer, degrees):
    found = fit(renderer, image(), turned_can(degrees))
    assert error(found) < 1.0
    assert (found.transform - TRUTH)[0, :3, 3].norm() < 0.01 * 7.0
    assert int(found.observable) == 6
    about_axis = R[:, 1] @ found.covariance[0, :3, :3] @ R[:, 1]
    assert about_axis.sqrt().rad2deg() < 10.0
    support, excess = edges_in(image(), BOX, CONTOURS, CAMERA, found.transform)
    assert float(found.edge_support) == pytest.approx(float(support), abs=0.01)
    assert float(found.edge_excess) == pytest.approx(float(excess), abs=0.01)


def test_a_label_is_found_without_red_and_the_last_round_draws_it_finer(renderer):
    without_red = torch.tensor([0.0, 1.0, 1.0])[:, None, None]
    drawn = []
    given = problem_of(renderer, image() * without_red, drawn)
    assert error(fit_texture(*given, turned_can(5.0))) < 1.0
    assert drawn == [1, 2]


def test_can_that_is_turned_far_is_found_from_turned_starts(renderer):
    start = turned_can(28.0)
    alone = fit(renderer, image(), start)
    assert alone is None or error(alone) > 5.0
    contours = fit_contours(CONTOURS, image(), BOX, CAMERA, start)
    assert int(contours.observable) == 5
    starts = rotated_starts(contours, CENTRE)
    assert len(starts) == 3
    assert error(fit(renderer, image(), starts)) < 1.0


def test_turned_starts_need_an_axis_that_contours_do_not_determine():
    covariance = torch.diag(double([0.1, 9.0, 0.1, 1e-4, 1e-4, 1e-4]))[None]

    def contours(covariance, observable):
        one = torch.ones(1)
        return ContourFit(TRUTH, covariance, one, one, torch.tensor([observable]), one)

    assert rotated_starts(contours(covariance, 6), CENTRE).equal(TRUTH)
    assert rotated_starts(contours(covariance * torch.nan, 0), CENTRE).equal(TRUTH)
    starts = rotated_starts(contours(covariance, 5), CENTRE)
    assert rotation_error(starts[:, :3, :3], R).round().tolist() == [0, 16, 16]
    assert torch.allclose((starts[1, :3, :3] @ R.mT)[1], double([0.0, 1, 0]))
    assert rotation_error(starts[1, :3, :3], starts[2, :3, :3]) == pytest.approx(32.0)


@pytest.mark.parametrize("shown", ["grey", "nothing"])
def test_pose_stays_where_the_photograph_does_not_show_the_colours(renderer, shown):
    grey = trimesh.Trimesh(MESH.vertices, MESH.faces, process=False)
    seen = photograph(grey, TRUTH) if shown == "grey" else torch.full((3, 180, 240), 0.5)
    assert fit(renderer, seen, turned_can(10.0)) is None


@pytest.mark.parametrize(("after", "counts"), [(0.46, False), (0.48, True)])
def test_fit_may_lose_a_little_edge_support(monkeypatch, renderer, after, counts):
    supports = iter([torch.tensor([0.5]), torch.tensor([after])])
    monkeypatch.setattr(ContourProblem, "edge_support", lambda *_: next(supports))
    assert (fit(renderer, image(), turned_can(5.0)) is not None) == counts


@pytest.mark.parametrize(
    ("before", "coarse", "fine", "counts"),
    [
        (1.0, 0.5, 0.5, False),  # no more than the start
        (0.0, 0.02, 0.5, False),
        (0.0, 0.04, 0.14, False),
        (0.0, 0.04, 0.16, True),
    ],
)
def test_fit_must_find_enough_corners_and_more_than_the_start(
    monkeypatch, renderer, before, coarse, fine, counts
):
    search = _TextureRounds.round
    ratios = iter([coarse, fine])
    monkeypatch.setattr(
        _TextureRounds,
        "round",
        lambda *given: replace(search(*given), before=before, after=next(ratios)),
    )
    assert (fit(renderer, image(), turned_can(5.0)) is not None) == counts


@pytest.mark.slow
def test_label_does_not_pull_a_pose_out_of_its_limits(monkeypatch):
    """They are 10 degrees away from the true rotation; no keypoints help."""
    monkeypatch.setattr(cr.Registrar, "keypoint_matches", lambda *_: None)
    views = cr.sample_views(azimuth_step=30, elevations=[20]).for_up("y")
    registrar = exact_registrar(bank_of(MESH, views))
    prior = cr.PosePrior(rotation=turned_can(16.0)[0, :3, :3], within=6.0)
    free, limited = (answer_of(registrar, image(), BOX, prior=p) for p in (None, prior))
    assert rotation_error(free.rotation, R) < 1.0
    assert prior.excess(limited.rotation) <= 3.0
    assert limited.hypotheses[0].covariance is not None, "its contours are fitted"


def test_match_finds_patches_that_moved_by_fractions_of_pixels_unless_they_slide_along_an_edge():
    rng = np.random.default_rng(0)
    view = cv2.GaussianBlur(rng.random((96, 96)).astype(np.float32), (0, 0), 2.0)
    shift = np.array([[1, 0, 3.3], [0, 1, -4.6]])
    # in other light
    photograph = 0.2 + 0.5 * cv2.warpAffine(view, shift, (96, 96), flags=cv2.INTER_CUBIC)
    offset, weight = match_patches(view, photograph, np.array([[30, 40], [48, 50], [60, 36]]), 8)
    assert np.abs(offset - (3.3, -4.6)).max() < 0.1
    assert weight.min() > 0.9
    view = np.zeros((96, 96), np.float32)
    view[48:] = 1.0
    _, weight = match_patches(view, view, np.array([[48, 48]]), 8)
    assert weight.tolist() == [0.0]
