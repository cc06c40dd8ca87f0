"""Focal lengths that a photograph contradicts."""

import math
from functools import cache
from unittest.mock import Mock

import pytest
import torch

from curvireg_torch.fitting.contour_problem import ContourProblem
from curvireg_torch.fitting.least_squares import PointMatches, pixels
from curvireg_torch.geometry import camera_matrix
from curvireg_torch.registration import camera as camera_module
from curvireg_torch.registration.block import Block
from curvireg_torch.registration.camera import focal_contradiction
from curvireg_torch.registration.hypotheses import Hypotheses
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from tests._support import learned_registrar, seeded, seen_from
from tests._support.spies import spied

SIZE = (360, 480)
FOCAL = 400.0


def camera(factor):
    return camera_matrix(factor * FOCAL, factor * FOCAL, 239.5, 179.5)


@cache
def near_photograph():
    """(3, H, W) and its box (4,): seen from nearby, so that perspective is strong."""
    T = seen_from(example_mesh(), 40.0, 25.0, radii=2.6)
    return synthesize_photograph(example_mesh(), T, camera(1.0), SIZE, seeded(0))


@cache
def registered(factor):
    """The result of a camera that is wrong by a factor, and what was given to measure that."""
    image, box = near_photograph()
    with pytest.MonkeyPatch.context() as patch:
        given = spied(patch, camera_module, "focal_gaps")
        return learned_registrar()([image], box[None], camera(factor))[0], given[0]


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.3])
def test_a_focal_length_that_the_photograph_contradicts_is_named_and_not_reliable(factor):
    result, _ = registered(factor)
    if factor == 1.0:
        assert result.reliable
        assert not result.warnings
        return
    assert result.confidence > 0.9
    assert not result.reliable
    assert "shows a focal length of about" in result.warnings[-1]
    shown = float(result.warnings[-1].split("about ")[1].split(" px")[0])
    assert shown == pytest.approx(FOCAL, rel=0.05)


def together(*factors):
    """What was given for each of several cameras, in one."""
    given = [registered(factor)[1] for factor in factors]
    describer, crops, _, _ = given[0]
    poses, printed = zip(*(one[2:] for one in given), strict=True)
    return describer, crops, Hypotheses.cat(poses), torch.cat(printed)


def test_focal_lengths_of_several_photographs_are_compared_at_once(monkeypatch):
    factors = (0.7, 1.0, 1.3)
    gaps, deviations = camera_module.focal_gaps(*together(*factors))
    alone = [float(camera_module.focal_gaps(*registered(factor)[1])[0]) for factor in factors]
    assert gaps.tolist() == pytest.approx(alone, abs=1e-5)
    assert gaps.tolist() == pytest.approx([0.357, 0.0, -0.262], abs=0.04)
    assert deviations[1] == torch.inf, "the first step is small: nobody looked further"
    assert float(deviations[0]) < 0.15
    monkeypatch.setattr(camera_module, "CLEAR_DEVIATION", float(deviations.min()))
    strict = camera_module.focal_gaps(*together(*factors))[1]
    assert strict.isinf().all(), "as clear as that, none is determined"


def test_the_print_of_each_photograph_is_compared_with_its_own_pose(monkeypatch):
    describer, crops, poses, _ = together(1.0, 0.7, 1.3)

    def missing(_, __, pose, problem):
        assert torch.equal(problem.K[0], (crops.transforms[0] @ pose.cameras[0]))
        return (FOCAL / pose.cameras[:, 0, 0]).log(), torch.tensor([0.01])

    monkeypatch.setattr(camera_module, "_fitted_to_print", missing)
    gaps, _ = camera_module.focal_gaps(describer, crops, poses, torch.tensor([True] * 3))
    assert gaps.tolist() == pytest.approx([0.0, -math.log(0.7), -math.log(1.3)])


def compared_by_print(monkeypatch, factor, matches):
    """Gap and deviation of :func:`registered` where matches, made by a function of the pixels at
    which the photograph shows points of the mesh, are found in it; and those by contours alone."""
    describer, crops, pose, _ = registered(factor)[1]
    truth = seen_from(example_mesh(), 40.0, 25.0, radii=2.6)[None]
    seen = ContourProblem.of(describer.contours, crops, camera(1.0)[None])
    model = seen.state(truth).points.model[:, ::20]
    uv = pixels(model, truth, seen.K)
    monkeypatch.setattr(camera_module, "texture_matches", lambda *_: matches(model, uv))
    found = [
        camera_module.focal_gaps(describer, crops, pose, torch.tensor([printed]))
        for printed in (True, False)
    ]
    return [(float(gap), float(deviation)) for gap, deviation in found]


def as_matches(model, uv):
    return PointMatches(model, uv, torch.ones(uv.shape[:2], dtype=torch.float64))


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_print_shows_the_focal_length_better_than_contours(monkeypatch, factor):
    by_print, by_contours = compared_by_print(monkeypatch, factor, as_matches)
    truth = -math.log(factor)
    assert by_print[0] == pytest.approx(truth, abs=0.02)
    assert abs(by_print[0] - truth) < abs(by_contours[0] - truth)
    assert by_print[1] < by_contours[1]
    few = compared_by_print(monkeypatch, factor, lambda *seen: as_matches(*seen).scaled(0.1))[0]
    assert few[1] > 1.2 * by_print[1], "matches that count less"
    monkeypatch.setattr(camera_module, "WITHIN_REACH", 0.0)  # contours tell too little
    assert compared_by_print(monkeypatch, factor, as_matches) == [by_print, (0.0, torch.inf)]


@pytest.mark.parametrize(
    "matches",
    [lambda *_: None, lambda model, uv: as_matches(model, uv + 20.0 * torch.randn_like(uv))],
)
def test_a_print_that_is_not_found_is_no_evidence(monkeypatch, matches):
    by_print, by_contours = compared_by_print(monkeypatch, 1.3, matches)
    assert by_print == by_contours
    assert by_print[0] < -0.2


@pytest.mark.parametrize("keypoints", [0.0, 0.1])
def test_prints_are_those_of_photographs_in_which_keypoints_count(monkeypatch, keypoints):
    image, box = near_photograph()
    nothing = torch.zeros(1)
    measure = Mock(return_value=(nothing, nothing))
    monkeypatch.setattr(Block, "printed", lambda *_: keypoints)
    monkeypatch.setattr(camera_module, "focal_gaps", measure)
    learned_registrar()([image], box[None], camera(1.0))
    *_, printed = measure.call_args.args
    assert printed.tolist() == [keypoints > 0.0]


def test_contradictions_need_a_clear_focal_length_two_deviations_and_a_distance_that_matters():
    for gap, deviation, given, is_named in (
        (0.21, 0.1, 0.0, True),
        (-0.21, 0.1, 0.0, True),
        (0.19, 0.1, 0.0, False),
        (0.6, torch.inf, 0.0, False),  # not determined
        (0.2, 0.05, 0.0, True),
        (0.2, 0.05, 0.1, False),  # the camera is not known better
        (-0.15, 0.01, 0.0, True),
        (-0.13, 0.01, 0.0, False),  # a distance that is less than 15 % off
    ):
        said = focal_contradiction(500.0, gap, deviation, given_deviation=given)
        assert (said is not None) == is_named
    assert "1000 px, not the camera's 500 px" in str(focal_contradiction(500.0, 0.69315, 0.01))
