"""Cameras that a photograph contradicts."""

import math
import re
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from kornia.geometry.transform import resize

from curvireg_torch.fitting.contour_problem import ContourProblem
from curvireg_torch.fitting.least_squares import PointMatches, pixels
from curvireg_torch.geometry import camera_matrix, rotation_error
from curvireg_torch.registration import Follower
from curvireg_torch.registration import camera as camera_module
from curvireg_torch.registration.camera import focal_contradiction, stretch_contradiction
from curvireg_torch.registration.hypotheses import Hypotheses
from curvireg_torch.registration.photograph import as_photograph
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from tests._support import answer_of, double, learned_registrar, seeded, seen_from
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
    """The result of a camera that is wrong by a factor, and its describer, crops and pose."""
    image, box = near_photograph()
    with pytest.MonkeyPatch.context() as patch:
        given = spied(patch, camera_module, "camera_gaps")
        return answer_of(learned_registrar(), image, box, camera(factor)), given[0]


def together(*factors):
    """Describer and crops of several cameras, and their poses in one."""
    given = [registered(factor)[1] for factor in factors]
    describer, crops, _ = given[0]
    return describer, crops, Hypotheses.cat([pose for _, _, pose in given])


def focal_gaps(describer, crops, poses, *, known=True, printed=False):
    """Gaps and deviations of focal lengths, (N,) each."""
    every = torch.ones(len(poses), dtype=torch.bool)
    found = camera_module.camera_gaps(
        describer, crops, poses, known=every & known, printed=every & printed
    )
    return [column[:, 1] for column in found]


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


def test_a_contradicted_camera_is_named_in_refined_poses_and_in_frames_that_follow():
    image, box = near_photograph()
    result, _ = registered(0.7)
    refined = learned_registrar().refine([image], camera(0.7), [result.projection[0]])[0]
    follow = Follower(learned_registrar(), camera(0.7))
    frames = [follow(image, box), follow(image), follow(image)]
    for one in (refined, *frames):
        assert rotation_error(one.rotation, result.rotation) < 1.0
        assert one.warnings == result.warnings
        assert not one.reliable


@cache
def stretched(wide, high, *, with_camera=True):
    """The result of a photograph of which both sides are longer by factors, and the camera's focal
    length is not."""
    image, box = near_photograph()
    H, W = (round(high * SIZE[0]), round(wide * SIZE[1]))
    picture = resize(image, (H, W), interpolation="bilinear", align_corners=False)
    box = box * torch.tensor([wide, high, wide, high])
    K = camera_matrix(FOCAL, FOCAL, 0.5 * (W - 1), 0.5 * (H - 1), dtype=torch.float64)
    return answer_of(learned_registrar(), picture, box, K if with_camera else None)


@pytest.mark.parametrize(
    ("wide", "high", "text"),
    [
        (1.25, 1.0, "stretched to 1.2. times its width"),
        (1.0, 1.25, "stretched to 1.2. times its height"),
    ],
)
@pytest.mark.parametrize("with_camera", [True, False])
def test_a_stretched_photograph_is_named_and_not_reliable(wide, high, text, with_camera):
    result = stretched(wide, high, with_camera=with_camera)
    assert result.confidence > 0.9
    assert not result.reliable
    assert re.search(text, result.warnings[-1])


def test_stretched_photographs_need_their_deviation_and_more_than_scans_are_off():
    assert stretch_contradiction(0.2, 0.1)
    assert stretch_contradiction(-0.2, 0.1)
    assert stretch_contradiction(0.18, 0.1) is None
    assert stretch_contradiction(0.15, 0.01)
    assert stretch_contradiction(0.14, 0.01) is None
    assert stretch_contradiction(0.9, math.inf) is None
    assert "to 1.49 times its height" in str(stretch_contradiction(-0.4, 0.01))


def test_focal_lengths_of_several_photographs_are_compared_at_once(monkeypatch):
    factors = (0.7, 1.0, 1.3)
    gaps, deviations = focal_gaps(*together(*factors))
    alone = [float(focal_gaps(*registered(factor)[1])[0]) for factor in factors]
    assert gaps.tolist() == pytest.approx(alone, abs=1e-5)
    assert gaps.tolist() == pytest.approx([0.357, 0.0, -0.262], abs=0.04)
    assert deviations[1] == torch.inf, "the first step is small: nobody looked further"
    assert float(deviations[0]) < 0.15
    monkeypatch.setattr(camera_module, "CLEAR_DEVIATION", float(deviations.min()))
    strict = focal_gaps(*together(*factors))[1]
    assert strict.isinf().all(), "as clear as that, none is determined"


def test_focal_lengths_that_are_not_known_are_not_compared():
    gaps, deviations = focal_gaps(*registered(0.7)[1], known=False)
    assert gaps.tolist() == [0.0]
    assert deviations.isinf().all()


def test_the_print_of_each_photograph_is_compared_with_its_own_pose(monkeypatch):
    describer, crops, poses = together(1.0, 0.7, 1.3)

    def missing(_, __, pose, problem):
        assert torch.equal(problem.K[0], (crops.transforms[0] @ pose.cameras[0]))
        return (FOCAL / pose.cameras[:, 0, 0]).log(), torch.tensor([0.01])

    monkeypatch.setattr(camera_module, "_fitted_to_print", missing)
    gaps, _ = focal_gaps(describer, crops, poses, printed=True)
    assert gaps.tolist() == pytest.approx([0.0, -math.log(0.7), -math.log(1.3)])


def compared_by_print(monkeypatch, factor, matches):
    """Gap and deviation of :func:`registered` where matches, made by a function of the pixels at
    which the photograph shows points of the mesh, are found in it; and those by contours alone."""
    describer, crops, pose = registered(factor)[1]
    truth = seen_from(example_mesh(), 40.0, 25.0, radii=2.6)[None]
    seen = ContourProblem.of(describer.contours, crops, camera(1.0)[None])
    model = seen.state(truth).points.model[:, ::20]
    uv = pixels(model, truth, seen.K)
    monkeypatch.setattr(camera_module, "texture_matches", lambda *_: matches(model, uv))
    found = [focal_gaps(describer, crops, pose, printed=printed) for printed in (True, False)]
    return [(float(gap), float(deviation)) for gap, deviation in found]


def as_matches(model, uv):
    return PointMatches(model, uv, torch.ones(uv.shape[:2], dtype=torch.float64))


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_print_shows_the_focal_length_better_than_contours(monkeypatch, factor):
    by_print, by_contours = compared_by_print(monkeypatch, factor, as_matches)
    truth = -math.log(factor)
    assert by_print[0] == pytest.approx(truth, abs=0.002)
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


def test_reliable_answers_are_compared_each_with_its_own_camera_and_print(monkeypatch):
    """Keypoints count in the last photograph."""
    result, (_, _, pose) = registered(1.0)
    results = [result.scaled(0.2), result, result]
    cameras = torch.stack([camera(factor) for factor in (1.0, 1.25, 1.5)])
    best = replace(Hypotheses.cat([pose] * 3), cameras=cameras)
    item = as_photograph(*near_photograph(), camera(1.0))
    block = SimpleNamespace(photographs=[item] * 3, printed=[0.0, 0.0, 0.1].__getitem__)
    measure = Mock(return_value=(double([[0.0, 0.5]] * 2), double([[0.01, 0.01]] * 2)))
    monkeypatch.setattr(camera_module, "camera_gaps", measure)
    target = SimpleNamespace(describer=None)
    found = camera_module.with_checked_cameras(target, block, None, best, results)
    assert measure.call_args.args[2].cameras.tolist() == cameras[1:].tolist()
    options = measure.call_args.kwargs
    assert options["printed"].tolist() == [False, True]
    assert options["known"].tolist() == [True, True]
    assert found[0].warnings == result.warnings
    assert "not the camera's 500 px" in found[1].warnings[-1]
    assert "not the camera's 600 px" in found[2].warnings[-1]


def test_contradictions_need_a_clear_focal_length_its_deviation_and_a_distance_that_matters():
    for gap, deviation, given, is_named in (
        (0.2, 0.1, 0.0, True),
        (-0.2, 0.1, 0.0, True),
        (0.18, 0.1, 0.0, False),
        (0.6, torch.inf, 0.0, False),  # not determined
        (0.36, 0.06, 0.1, True),
        (0.33, 0.06, 0.1, False),  # the camera is not known better
        (-0.15, 0.01, 0.0, True),
        (-0.14, 0.01, 0.0, False),  # a distance that is less than 15 % off
    ):
        said = focal_contradiction(500.0, gap, deviation, given_deviation=given)
        assert (said is not None) == is_named
    assert "1000 px, not the camera's 500 px" in str(focal_contradiction(500.0, 0.69315, 0.01))
