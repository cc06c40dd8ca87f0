"""Following: generated sequences with bounded errors, frames without the object, and starts that
are wrong."""

import json
import math
import pickle
from copy import deepcopy
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from curvireg_torch import Registrar
from curvireg_torch.errors import LostObjectError
from curvireg_torch.geometry import Camera, PosePrior, rotation_from_axis_angle
from curvireg_torch.geometry.cameras import pose_around
from curvireg_torch.pipeline import DetectionSettings
from curvireg_torch.registration import FailedRegistration, Follower, refine, tracking
from curvireg_torch.registration.tracking import BELIEVED_CONFIDENCE
from curvireg_torch.synthetic import example_mesh, procedural_background, synthesize_photograph
from tests._support import (
    CAMERA,
    SIZE,
    check_near,
    degrees_off,
    double,
    learned_registrar,
    refused,
    seeded,
    sequence,
    slow_after,
    truck_registrar,
)
from tests._support.hypotheses import HALF_TURN
from tests._support.results import registration
from tests._support.spies import spied

TRACKED = {"edge_support", "region", "flow", "keyframe"}
LOST = Mock(side_effect=LostObjectError("lost"))


def check_pose(result, T, degrees=4.0, share=0.04):
    check_near(result.transform, T, degrees, share)


def follower(registrar=None):
    """A follower that knows the pose in the first frame of a sequence."""
    image, _, T = sequence(1)[0]
    follow = Follower(registrar or truck_registrar(), CAMERA)
    follow.start(image, T)
    return follow


def test_a_follower_in_use_can_be_pickled_and_copied():
    follow = follower()
    copies = [pickle.loads(pickle.dumps(follow)), deepcopy(follow)]
    image, _, _ = sequence(2)[1]
    expected = follow(image)
    for other in copies:
        assert other(image).transform.equal(expected.transform)


def test_follower_keeps_the_object_over_a_sequence():
    (image, box, T), *frames = sequence(6)
    follow = Follower(learned_registrar(), CAMERA)
    first = follow(image, box)
    check_pose(first, T)
    assert first.confidence >= BELIEVED_CONFIDENCE
    for image, _, T in frames:
        result = follow(image)
        check_pose(result, T)
        assert 0.3 < result.confidence <= first.confidence


def test_follower_starts_from_a_known_pose_without_registering(monkeypatch):
    follow = follower()
    monkeypatch.setattr(tracking, "refine_one", None)  # neither search
    monkeypatch.setattr(Registrar, "register_prepared", None)  # nor registration
    for image, _, T in sequence(4)[1:]:
        result = follow(image)
        check_pose(result, T, degrees=2.0, share=0.02)
        assert 0.5 < result.confidence <= 1.0
        assert torch.equal(result.transform[:3, 3], result.translation)
        assert set(result.confidence_features) == TRACKED
        json.dumps(result.to_dict(), allow_nan=False)


@pytest.mark.parametrize("starts", [True, False])
def test_the_camera_of_the_first_frame_is_scaled_for_frames_of_another_size(starts):
    (image, box, T), (second, second_box, second_T), (third, _, _) = sequence(3)
    follow = Follower(learned_registrar(), CAMERA)
    if starts:
        follow.start(image, T)
    else:
        check_pose(follow(image, box), T)
    larger = torch.nn.functional.interpolate(second[None], scale_factor=2.0, mode="bilinear")[0]
    check_pose(follow(larger, 2.0 * second_box + 0.5), second_T)
    failed = follow(third[:, :100])
    assert not failed.ok
    assert "calibrated for 240 x 180 px, but the photograph has 240 x 100 px" in str(failed.error)


@pytest.mark.parametrize(
    "given",
    [CAMERA[None], CAMERA.numpy(), CAMERA.tolist(), Camera(CAMERA)],
    ids=lambda given: type(given).__name__,
)
def test_cameras_of_all_forms_get_the_size_of_the_first_frame(given):
    image, _, T = sequence(1)[0]
    follow = Follower(truck_registrar(), given)
    follow.start(image, T)
    assert follow.camera_matrix.size == SIZE
    assert follow.camera_matrix.matrix.equal(CAMERA)


def test_limits_are_those_of_frames_that_are_registered(monkeypatch):
    registered = Mock(return_value=[FailedRegistration(LostObjectError("lost"))])
    refined = Mock(side_effect=LostObjectError("lost"))
    monkeypatch.setattr(Registrar, "register_prepared", registered)
    monkeypatch.setattr(tracking, "refine_one", refined)
    (image, box, T), (second, _, _) = sequence(2)
    prior = PosePrior(elevation=(0.0, 60.0))
    follow = Follower(truck_registrar(), CAMERA, prior=prior)
    follow(image, box)
    (item,) = registered.call_args.args[0]
    assert item.prior is prior
    follow.start(image, T)
    monkeypatch.setattr(follow._tracker, "track", LOST)
    follow(second)
    assert refined.call_args.args[1].prior is None


def answer(T, confidence):
    """A registration with this pose."""
    made = registration(confidence=confidence)
    first = replace(made.hypotheses[0], projection=(T, CAMERA))
    return replace(made, hypotheses=(first, *made.hypotheses[1:]))


def answering(monkeypatch, *answers):
    """Let the registrar give these results, one a call."""
    given = iter(answers)
    monkeypatch.setattr(Registrar, "register_prepared", lambda *_, **__: [next(given)])


@pytest.mark.parametrize(
    ("confidences", "degrees", "part", "base"),
    [
        ([BELIEVED_CONFIDENCE - 0.01] * 2 + [0.8], 0.0, 0.0, 0.8),
        ([0.015, 0.015, 0.8], 0.0, 0.0, 0.8),
        ([BELIEVED_CONFIDENCE - 0.01] * 2, 0.0, 0.0, None),
        ([0.4] * 3, 0.0, 0.0, 0.4),
        ([0.4, 0.19, 0.4, 0.4], 0.0, 0.0, None),
        ([0.4] * 3, 14.0, 0.09, 0.4),
        ([0.4] * 4, 16.0, 0.0, None),
        ([0.4] * 4, 0.0, 0.11, None),
        ([0.4] * 5, 16.0, 0.0, 0.4),
        ([0.4] * 5, 0.0, 0.11, 0.4),
    ],
)
def test_a_pose_is_followed_if_it_is_believed_or_three_agree(
    monkeypatch, confidences, degrees, part, base
):
    """Its confidence does not rise. The second one is turned about the object's centre, or moved by
    a part of its distance."""
    (image, box, T), (second, _, T_second) = sequence(2)
    follow = Follower(truck_registrar(), CAMERA)
    centre = follow.registrar.describer.centre
    turn = rotation_from_axis_angle(torch.deg2rad(double([0.0, degrees, 0.0])))
    at = (T[:3, :3] @ centre + T[:3, 3]) * (1.0 + part)
    poses = [T] * len(confidences)
    poses[1] = pose_around(turn @ T[:3, :3], at, centre)
    answering(monkeypatch, *map(answer, poses, confidences))
    for confidence in confidences:
        assert follow(image, box).confidence == confidence
    assert follow._base == base
    if base is not None:
        result = follow(second)
        check_pose(result, T_second)
        assert result.confidence <= base
        assert set(result.confidence_features) == TRACKED


def test_confidence_is_a_fraction_of_that_of_the_first_pose_and_not_raised_by_the_same_frame(
    monkeypatch,
):
    (image, box, T), (second, _, _) = sequence(2)
    found = []
    for first in (1.0, 0.7):
        follow = Follower(truck_registrar(), CAMERA)
        answering(monkeypatch, answer(T, first))
        follow(image, box)
        found.append(follow(second))
    assert found[1].confidence == pytest.approx(0.7 * found[0].confidence, rel=1e-6)
    follow = Follower(truck_registrar(), CAMERA)
    answering(monkeypatch, answer(T, 0.6))
    assert max(follow(image, box).confidence for _ in range(5)) <= 0.6


@pytest.mark.parametrize("with_box", slow_after(1, [True, False]))
def test_a_wrong_start_never_becomes_believed(with_box):
    """Seen from behind: a registration of the next frame does not confirm it."""
    frames = sequence(2)
    follow = Follower(learned_registrar(), CAMERA)
    follow.start(frames[0][0], frames[0][2] @ HALF_TURN)
    follow._base = 0.45  # doubtful
    image, box, T = frames[1]
    result = follow(image, box if with_box else None)
    assert not result.ok or degrees_off(result, T) < 5.0 or result.confidence < BELIEVED_CONFIDENCE


def test_a_doubtful_pose_that_is_kept_does_not_gain_confidence(monkeypatch):
    """Until a registration of a later frame confirms it."""
    frames = sequence(5)
    follow = follower(learned_registrar())
    with monkeypatch.context() as patch:
        patch.setattr(tracking, "refine_one", LOST)
        with monkeypatch.context() as doubtful:
            doubtful.setattr(tracking, "tracking_confidence", lambda _: 0.3)
            assert follow(frames[1][0]).confidence == pytest.approx(0.3)
        assert follow(frames[2][0]).confidence <= 0.3
    confirmed = follow(frames[3][0])
    assert confirmed.confidence > BELIEVED_CONFIDENCE
    assert degrees_off(confirmed, frames[3][2]) < 4.0
    monkeypatch.setattr(tracking, "refine_one", LOST)
    assert follow(frames[4][0]).confidence > BELIEVED_CONFIDENCE, "tracked from the confirmed pose"


def test_follower_refines_where_tracking_is_doubtful(monkeypatch):
    """The object jumps by 11 degrees and a tenth of its distance."""
    T = sequence(1)[0][2]
    jumped = T.clone()
    jumped[:3, :3] = rotation_from_axis_angle(double([0.0, 0.2, 0.0])) @ T[:3, :3]
    jumped[0, 3] += 0.1 * T[2, 3]
    there = synthesize_photograph(example_mesh(), jumped, CAMERA, SIZE, seeded(9))[0]
    monkeypatch.setattr(tracking, "TRUSTED_CONFIDENCE", 1.1)  # whatever the tracker says
    calls = spied(monkeypatch, tracking, "refine_one")
    assert degrees_off(follower()(there), jumped) < 4.0
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("tracked", "registered", "expected"),
    [(0.19, None, None), (0.21, None, 0.21), (0.1, 0.89, None), (0.1, 0.95, 0.95)],
)
def test_a_doubtful_pose_is_kept_above_a_limit_and_below_one_that_is_registered_reliably(
    monkeypatch, tracked, registered, expected
):
    image, box, T = sequence(2)[1]
    follow = follower()
    monkeypatch.setattr(tracking, "tracking_confidence", lambda _: tracked)
    monkeypatch.setattr(tracking, "refine_one", LOST)
    failed = FailedRegistration(LostObjectError("no"))
    answering(monkeypatch, answer(T, registered) if registered else failed)
    result = follow(image, box)
    assert result.ok == (expected is not None)
    assert not result.ok or result.confidence == pytest.approx(expected)


def test_frames_after_an_answer_that_is_questioned_are_not_reliable_either(monkeypatch):
    (image, box, T), (second, _, _) = sequence(2)
    monkeypatch.setattr(tracking, "tracking_confidence", lambda _: 1.0)
    found = []
    for contradiction in (None, "better outside"):
        follow = Follower(truck_registrar(), CAMERA)
        answering(monkeypatch, replace(answer(T, 0.95), prior_contradiction=contradiction))
        follow(image, box)
        found.append(follow(second).verdict)
    assert found == ["reliable", "unsure"]


def test_a_frame_that_is_less_sure_than_the_one_before_is_checked(monkeypatch):
    """Learned from unchecked, a wrong pose would be tracked with certainty from then on."""
    monkeypatch.setattr(tracking, "is_calibrated", lambda _: True)
    image, _, T = sequence(2)[1]
    wrong = answer(T @ HALF_TURN, 0.0)
    checks = []
    for base, tracked in ((1.0, 0.91), (0.92, 0.95), (1.0, 0.89), (0.89, 0.89), (0.89, 0.56)):
        follow = follower()
        follow._base = base
        monkeypatch.setattr(tracking, "tracking_confidence", lambda _, tracked=tracked: tracked)
        refine = Mock(return_value=wrong)
        monkeypatch.setattr(tracking, "refine_one", refine)
        assert follow(image).confidence == pytest.approx(base * tracked)
        checks.append(refine.call_count)
        monkeypatch.setattr(tracking, "tracking_confidence", lambda _: 1.0)
        assert follow(image).reliable == (tracked > 0.9)
    assert checks == [0, 0, 1, 0, 1]


@pytest.mark.parametrize("refined", [0.7, 0.85])
def test_frames_that_are_less_sure_are_checked_again_after_8_16_and_32(monkeypatch, refined):
    monkeypatch.setattr(tracking, "is_calibrated", lambda _: True)
    image, _, T = sequence(2)[1]
    follow = follower()
    follow._base = 0.8
    monkeypatch.setattr(tracking, "tracking_confidence", lambda _: 1.0)
    refine = Mock(return_value=answer(T, refined))
    monkeypatch.setattr(tracking, "refine_one", refine)
    checked = []
    for number in range(1, 33):
        follow(image)
        checked += [number] * (refine.call_count > len(checked))
    assert checked == [8, 16, 32]
    refine.return_value = answer(T, 0.97)
    monkeypatch.setattr(tracking, "FIRST_CHECK", 1)
    follow._unsure = 63
    assert follow(image).reliable
    assert follow(image).confidence == pytest.approx(0.97)
    assert refine.call_count == 4


def test_without_calibration_no_registration_checks_a_tracked_pose(monkeypatch):
    follow = follower()
    monkeypatch.setattr(tracking, "is_calibrated", lambda _: False)
    monkeypatch.setattr(tracking, "tracking_confidence", lambda _: 0.7)
    monkeypatch.setattr(tracking, "refine_one", None)
    assert follow(sequence(2)[1][0]).confidence == pytest.approx(0.7)


def test_warnings_of_camera_and_mesh_hold_for_later_frames_and_others_do_not(monkeypatch):
    (image, _, T), *_ = sequence(2)
    follow = follower()
    focal, outside = "the photograph shows a focal length of about {} px", "30 % lies outside"
    monkeypatch.setattr(tracking, "tracking_confidence", lambda _: 0.1)
    said = []
    for number in (400, 405):
        warnings = (focal.format(number), outside)
        refined = replace(answer(T, 0.95), warnings=warnings)
        monkeypatch.setattr(tracking, "refine_one", Mock(return_value=refined))
        said.append(follow(image).warnings)
    assert said[1] == (focal.format(405), outside)
    monkeypatch.setattr(tracking, "tracking_confidence", lambda _: 1.0)
    assert follow(image).warnings == (focal.format(400),)


def zoomed(image, factor):
    """The middle of an image, enlarged."""
    H, W = SIZE
    h, w = round(H / factor), round(W / factor)
    y, x = (H - h) // 2, (W - w) // 2
    middle = image[None, :, y : y + h, x : x + w]
    return torch.nn.functional.interpolate(middle, SIZE, mode="bilinear")[0]


@pytest.mark.parametrize(
    ("factor", "refined", "base"),
    [(1.1, None, 1.0), (1.25, 0.6, 0.9), (1.25, None, 0.9), (1.25, 0.97, 0.97)],
)
def test_a_pose_at_another_distance_is_checked_once_for_another_zoom(
    monkeypatch, factor, refined, base
):
    """The tracker is as certain as before; unless the check is, its poses are not reliable."""
    monkeypatch.setattr(tracking, "is_calibrated", lambda _: True)
    monkeypatch.setattr(tracking, "tracking_confidence", lambda _: 1.0)
    warnings = ("the photograph shows a focal length of about 400 px",) * (refined == 0.6)
    follow = follower()
    frames = sequence(3)[1:]
    T = frames[0][2].clone()
    T[2, 3] /= factor
    checked = LOST if refined is None else Mock()
    if refined is not None:
        checked.return_value = replace(answer(T, refined), warnings=warnings)
    refine = Mock(wraps=checked)
    monkeypatch.setattr(tracking, "refine_one", refine)
    for image, _, _ in frames:
        result = follow(zoomed(image, factor))
        assert result.warnings == warnings
        assert result.confidence == pytest.approx(base)
        assert result.reliable == (base > 0.9)
    assert refine.call_count == (factor > 1.2)


def test_a_refined_pose_of_no_confidence_is_not_followed(monkeypatch):
    """It would bound all later ones, so that no frame were registered again."""
    image, box, T = sequence(2)[1]
    follow = follower()
    monkeypatch.setattr(tracking, "tracking_confidence", lambda _: 0.1)
    monkeypatch.setattr(tracking, "refine_one", lambda *_: answer(T @ HALF_TURN, 0.19))
    answering(monkeypatch, answer(T, 0.95))
    assert follow(image, box).confidence == 0.95


@pytest.mark.slow
def test_follower_loses_an_absent_object_and_finds_it_again():
    frames = sequence(2)
    known = learned_registrar()
    few = replace(known.pipeline, detection=DetectionSettings(proposals=4, min_size=0.2))
    follow = Follower(Registrar(known.bank, pipeline=few), CAMERA)
    follow(*frames[0][:2])
    empty = procedural_background(SIZE, seeded(5))
    lost = follow(empty)
    assert not lost.ok or lost.confidence < BELIEVED_CONFIDENCE
    result = follow(frames[1][0])
    assert degrees_off(result, frames[1][2]) < 4.0


@pytest.mark.parametrize("confidence", [math.nan, 1.5, -0.1, "sure"])
def test_a_start_needs_a_probability(confidence):
    image, _, T = sequence(1)[0]
    with refused("confidence"):
        Follower(truck_registrar(), CAMERA).start(image, T, confidence=confidence)
    with refused("start_confidences"):
        refine(truck_registrar(), [image], CAMERA, [T], start_confidences=[confidence])


@pytest.mark.slow
def test_frames_below_one_half_are_checked_and_a_start_of_no_confidence_is_kept(monkeypatch):
    """What decides is the confidence that is reported: that of the start times the tracker's."""
    (first, _, start), (second, _, T) = sequence(2)
    calls = spied(monkeypatch, tracking, "refine_one")
    monkeypatch.setattr(Follower, "_registered", Mock(side_effect=AssertionError("dropped")))
    for confidence, checks in ((1.0, 0), (0.45, 1), (0.0, 1)):
        calls.clear()
        follow = Follower(learned_registrar(), CAMERA)
        follow.start(first, start, confidence=confidence)
        assert degrees_off(follow(second), T) < 5.0
        assert len(calls) == checks
