"""Following: generated sequences with bounded errors, frames without the object, and starts that
are wrong."""

import json
import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch

from curvireg_torch import Registrar
from curvireg_torch.errors import LostObjectError
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.geometry.cameras import pose_around
from curvireg_torch.registration import FailedRegistration, Follower, refine, tracking
from curvireg_torch.registration.tracking import BELIEVED_CONFIDENCE
from curvireg_torch.synthetic import example_mesh, procedural_background, synthesize_photograph
from tests._support import (
    CAMERA,
    SIZE,
    double,
    errors,
    learned_registrar,
    refused,
    seeded,
    sequence,
    slow_after,
    truck_registrar,
)

LOST = Mock(side_effect=LostObjectError("lost"))


def test_follower_keeps_the_object_over_a_sequence():
    frames = sequence(6)
    follow = Follower(learned_registrar(), CAMERA)
    results = [follow(image, box if k == 0 else None) for k, (image, box, _) in enumerate(frames)]
    first = results[0].confidence
    assert first >= BELIEVED_CONFIDENCE
    for result, (_, _, T) in zip(results, frames, strict=True):
        degrees, position = errors(result, T)
        assert degrees < 4.0
        assert position < 0.04
        assert 0.3 < result.confidence <= first


def test_follower_starts_from_a_known_pose_without_registering(monkeypatch):
    frames = sequence(4)
    registrar = truck_registrar()
    follow = Follower(registrar, CAMERA)
    follow.start(frames[0][0], frames[0][2])
    monkeypatch.setattr(tracking, "refine_one", None)  # neither search
    monkeypatch.setattr(type(registrar), "register_prepared", None)  # nor registration
    for image, _, T in frames[1:]:
        result = follow(image)
        degrees, position = errors(result, T)
        assert degrees < 2.0
        assert position < 0.02
        assert 0.5 < result.confidence <= 1.0
        assert torch.equal(result.transform[:3, 3], result.translation)
        assert set(result.confidence_features) == {"edge_support", "region", "flow", "keyframe"}
        json.dumps(result.to_dict(), allow_nan=False)


def answering(monkeypatch, registrar, answers):
    """Let the registrar give these confidences, one a call, for the true pose of the frame's
    object."""
    given = iter(answers)
    register = type(registrar).register_prepared

    def call(self, items, **options):
        found = register(self, items, **options)[0]
        object.__setattr__(found, "probabilities", (next(given), 0.0))
        return [found]

    monkeypatch.setattr(type(registrar), "register_prepared", call)


@pytest.mark.parametrize("first", slow_after(1, [BELIEVED_CONFIDENCE - 0.01, 0.015]))
def test_a_pose_that_is_not_believed_is_not_followed(monkeypatch, first):
    """It is registered again in the next frames, and no confidence rises by being followed."""
    frames = sequence(4)
    registrar = truck_registrar()
    answering(monkeypatch, registrar, [first, first, 0.8])
    follow = Follower(registrar, CAMERA)
    results = [follow(image, box) for image, box, _ in frames]
    assert [r.confidence for r in results[:3]] == [first, first, 0.8]
    assert set(results[3].confidence_features) == {"edge_support", "region", "flow", "keyframe"}, (
        "tracked"
    )
    assert results[3].confidence <= 0.8


@pytest.mark.parametrize(
    ("answers", "follows"), [([0.4] * 3, True), ([0.4, 0.19, 0.4, 0.4], False)]
)
def test_registrations_that_agree_are_followed_without_more_confidence(
    monkeypatch, answers, follows
):
    frames = sequence(len(answers) + 1)
    registrar = truck_registrar()
    answering(monkeypatch, registrar, answers)
    follow = Follower(registrar, CAMERA)
    for (image, box, _), answer in zip(frames, answers, strict=False):
        assert follow(image, box).confidence == answer
    assert (follow._base is not None) is follows
    if follows:
        assert follow._base == 0.4
        result = follow(frames[-1][0])
        degrees, position = errors(result, frames[-1][2])
        assert (degrees < 4.0, position < 0.04) == (True, True)


@pytest.mark.parametrize(("degrees", "part"), slow_after(1, [(16.0, 0.0), (0.0, 0.11)]))
def test_registrations_that_disagree_are_not_followed(monkeypatch, degrees, part):
    """The second is turned about the object's centre, or moved by a part of its distance."""
    (image, box, _) = sequence(1)[0]
    registrar = truck_registrar()
    register = type(registrar).register_prepared
    centre = registrar.describer.centre
    calls = []

    def call(self, items, **options):
        found = register(self, items, **options)[0]
        object.__setattr__(found, "probabilities", (0.4, 0.0))
        T, K = found.projection
        calls.append(T)
        if len(calls) == 2:
            turn = rotation_from_axis_angle(torch.deg2rad(double([0.0, degrees, 0.0])))
            at = (T[:3, :3] @ centre + T[:3, 3]) * (1.0 + part)
            moved = pose_around(turn @ T[:3, :3], at, centre)
            first = replace(found.hypotheses[0], projection=(moved, K))
            object.__setattr__(found, "hypotheses", (first, *found.hypotheses[1:]))
        return [found]

    monkeypatch.setattr(type(registrar), "register_prepared", call)
    follow = Follower(registrar, CAMERA)
    for _ in range(4):
        follow(image, box)
    assert follow._base is None
    follow(image, box)
    assert follow._base == 0.4, "the last three agree"


def test_confidence_is_a_fraction_of_that_of_the_first_pose_and_not_raised_by_the_same_frame(
    monkeypatch,
):
    frames = sequence(2)
    found = []
    for first in (1.0, 0.7):
        registrar = truck_registrar()
        with monkeypatch.context() as patch:
            answering(patch, registrar, [first])
            follow = Follower(registrar, CAMERA)
            follow(*frames[0][:2])
            found.append(follow(frames[1][0]))
    assert found[1].confidence == pytest.approx(0.7 * found[0].confidence, rel=1e-6)
    registrar = truck_registrar()
    answering(monkeypatch, registrar, [0.6])
    follow = Follower(registrar, CAMERA)
    assert max(follow(*frames[0][:2]).confidence for _ in range(5)) <= 0.6


@pytest.mark.parametrize("with_box", slow_after(1, [True, False]))
def test_a_wrong_start_never_becomes_believed(with_box):
    """Seen from behind: a registration of the next frame does not confirm it."""
    frames = sequence(2)
    behind = torch.diag(double([-1.0, -1.0, 1.0, 1.0]))
    follow = Follower(learned_registrar(), CAMERA)
    follow.start(frames[0][0], frames[0][2] @ behind)
    follow._base = 0.45  # doubtful
    image, box, T = frames[1]
    result = follow(image, box if with_box else None)
    assert not result.ok or errors(result, T)[0] < 5.0 or result.confidence < BELIEVED_CONFIDENCE


def test_a_doubtful_pose_that_is_kept_does_not_gain_confidence(monkeypatch):
    """Until a registration of a later frame confirms it."""
    frames = sequence(5)
    follow = Follower(learned_registrar(), CAMERA)
    follow.start(frames[0][0], frames[0][2])
    with monkeypatch.context() as patch:
        patch.setattr("curvireg_torch.registration.tracking.tracking_confidence", lambda _: 0.3)
        patch.setattr(tracking, "refine_one", LOST)
        assert follow(frames[1][0]).confidence == pytest.approx(0.3)
    with monkeypatch.context() as patch:
        patch.setattr(tracking, "refine_one", LOST)
        assert follow(frames[2][0]).confidence <= 0.3
    confirmed = follow(frames[3][0])
    assert confirmed.confidence > BELIEVED_CONFIDENCE
    assert errors(confirmed, frames[3][2])[0] < 4.0
    monkeypatch.setattr(tracking, "refine_one", LOST)
    assert follow(frames[4][0]).confidence > BELIEVED_CONFIDENCE, "tracked from the confirmed pose"


def test_follower_refines_where_tracking_is_doubtful(monkeypatch):
    """The object jumps by 11 degrees and a tenth of its distance."""
    image, _, T = sequence(1)[0]
    jumped = T.clone()
    jumped[:3, :3] = rotation_from_axis_angle(double([0.0, 0.2, 0.0])) @ T[:3, :3]
    jumped[0, 3] += 0.1 * T[2, 3]
    there = synthesize_photograph(example_mesh(), jumped, CAMERA, SIZE, seeded(9))[0]
    calls = []
    refine_one = tracking.refine_one
    monkeypatch.setattr(tracking, "TRUSTED_CONFIDENCE", 1.1)  # whatever the tracker says
    monkeypatch.setattr(
        tracking, "refine_one", lambda *a, **k: calls.append(a) or refine_one(*a, **k)
    )
    follow = Follower(truck_registrar(), CAMERA)
    follow.start(image, T)
    assert errors(follow(there), jumped)[0] < 4.0
    assert len(calls) == 1


@pytest.mark.parametrize(("tracked", "kept"), [(0.19, False), (0.21, True)])
def test_doubtful_pose_is_kept_above_a_limit(monkeypatch, tracked, kept):
    frames = sequence(2)
    follow = Follower(truck_registrar(), CAMERA)
    follow.start(frames[0][0], frames[0][2])
    monkeypatch.setattr(
        "curvireg_torch.registration.tracking.tracking_confidence", lambda _: tracked
    )
    monkeypatch.setattr(tracking, "refine_one", LOST)
    failed = FailedRegistration(LostObjectError("no"))
    monkeypatch.setattr(Registrar, "register_prepared", lambda *_, **__: [failed])
    result = follow(frames[1][0])
    assert result.ok == kept
    assert not kept or result.confidence == pytest.approx(tracked)


@pytest.mark.parametrize(("confidence", "used"), [(0.89, False), (0.95, True)])
def test_a_lost_frame_is_registered_and_counts_if_that_is_reliable(monkeypatch, confidence, used):
    frames = sequence(2)
    registrar = truck_registrar()
    follow = Follower(registrar, CAMERA)
    follow.start(frames[0][0], frames[0][2])
    monkeypatch.setattr("curvireg_torch.registration.tracking.tracking_confidence", lambda _: 0.1)
    monkeypatch.setattr(tracking, "refine_one", LOST)
    answering(monkeypatch, registrar, [confidence])
    result = follow(*frames[1][:2])
    assert result.ok == used
    assert not used or result.confidence == confidence


def test_follower_loses_an_absent_object_and_finds_it_again():
    frames = sequence(2)
    follow = Follower(learned_registrar(), CAMERA)
    follow(*frames[0][:2])
    empty = procedural_background(SIZE, seeded(5))
    lost = follow(empty)
    assert not lost.ok or lost.confidence < BELIEVED_CONFIDENCE
    result = follow(frames[1][0])
    assert errors(result, frames[1][2])[0] < 4.0


@pytest.mark.parametrize("confidence", [math.nan, 1.5, -0.1, "sure"])
def test_a_start_needs_a_probability(confidence):
    image, _, T = sequence(1)[0]
    with refused("confidence"):
        Follower(truck_registrar(), CAMERA).start(image, T, confidence=confidence)
    with refused("start_confidences"):
        refine(truck_registrar(), [image], CAMERA, [T], start_confidences=[confidence])


def test_frames_below_one_half_are_checked_and_a_start_of_no_confidence_is_kept(monkeypatch):
    """What decides is the confidence that is reported: that of the start times the tracker's."""
    frames = sequence(2)
    for confidence, checks in ((1.0, 0), (0.45, 1), (0.0, 1)):
        calls = []
        follow = Follower(learned_registrar(), CAMERA)
        follow.start(frames[0][0], frames[0][2], confidence=confidence)
        refined = tracking.refine_one
        monkeypatch.setattr(
            tracking, "refine_one", lambda *a, f=refined, c=calls: (c.append(1), f(*a))[1]
        )
        monkeypatch.setattr(
            follow, "_registered", lambda *_: pytest.fail("the given pose was dropped")
        )
        result = follow(frames[1][0])
        monkeypatch.undo()
        assert len(calls) == checks
        assert errors(result, frames[1][2])[0] < 5.0
