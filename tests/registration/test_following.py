"""Following: a generated sequence of rotating and approaching objects, and a frame in which the object is absent."""

import json

import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_error, rotation_from_axis_angle
from curvireg_torch.registration import Follower, following, refine
from curvireg_torch.synthetic import example_mesh, procedural_background, synthesize_photograph
from tests._support.scenes import CAMERA, scene, truck_registrar

SIZE = (180, 240)


def sequence(count):
    """Photographs and true poses: 4 degrees about a vertical axis and 2 % nearer from frame to frame."""
    _, _, T = scene(0)
    step = rotation_from_axis_angle(torch.tensor([0.0, 0.07, 0.0], dtype=torch.float64))
    frames = []
    for _ in range(count):
        generator = torch.Generator().manual_seed(9)
        frames.append((*synthesize_photograph(example_mesh(), T, CAMERA, SIZE, generator), T))
        T = T.clone()
        T[:3, :3] = step @ T[:3, :3]
        T[:3, 3] *= 0.98
    return frames


def test_follower_keeps_the_object_over_a_sequence():
    frames = sequence(6)
    follow = Follower(truck_registrar(), CAMERA)
    for k, (image, box, T) in enumerate(frames):
        result = follow(image, box if k == 0 else None)
        assert float(rotation_error(result.rotation, T[:3, :3])) < 4.0
        assert float((result.translation - T[:3, 3]).norm() / T[:3, 3].norm()) < 0.04


def test_follower_starts_from_a_known_pose_without_registering(monkeypatch):
    frames = sequence(4)
    registrar = truck_registrar()
    follow = Follower(registrar, CAMERA)
    follow.start(frames[0][0], frames[0][2])
    monkeypatch.setattr(following, "refine", None)  # neither search
    monkeypatch.setattr(type(registrar), "__call__", None)  # nor registration
    for image, _, T in frames[1:]:
        result = follow(image)
        assert float(rotation_error(result.rotation, T[:3, :3])) < 2.0
        assert float((result.translation - T[:3, 3]).norm() / T[:3, 3].norm()) < 0.02
        assert 0.5 < result.confidence <= 1.0
        assert torch.equal(result.transform[:3, 3], result.translation)
        assert set(result.confidence_features) == {"edge_support", "region", "flow", "keyframe"}
        json.dumps(result.to_dict(), allow_nan=False)


@pytest.mark.parametrize("threads", [1, 2])
def test_follower_takes_frames_with_gradients_on_any_threads(threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    frames = sequence(3)
    follow = Follower(truck_registrar(), CAMERA)
    follow.start(frames[0][0].requires_grad_(), frames[0][2])
    results = [follow(image.requires_grad_()) for image, _, _ in frames[1:]]
    torch.set_num_threads(before)
    assert all(result.ok and not result.rotation.requires_grad for result in results)


def test_a_registered_pose_outside_the_frame_is_returned_and_not_followed(monkeypatch):
    image, box, T = sequence(1)[0]
    registrar = truck_registrar()
    result = registrar([image], box[None], CAMERA)[0]
    follow = Follower(registrar, CAMERA)
    behind = torch.eye(4, dtype=torch.float64)
    behind[2, 3] = -9.0
    monkeypatch.setattr(following, "_pose", lambda _: behind)
    found = follow(image, box)
    assert torch.equal(found.rotation, result.rotation)
    monkeypatch.undo()
    assert float(rotation_error(follow(image, box).rotation, T[:3, :3])) < 4.0  # registered again


def test_confidence_is_at_most_that_of_the_first_pose():
    frames = sequence(2)
    results = []
    for known in (1.0, 0.7):
        follow = Follower(truck_registrar(), CAMERA)
        follow.start(frames[0][0], frames[0][2])
        follow._known = known
        results.append(follow(frames[1][0]).confidence)
    assert results[1] == pytest.approx(0.7 * results[0])


def test_follower_searches_where_tracking_is_doubtful(monkeypatch):
    """The object jumps by 11 degrees and a tenth of its distance."""
    (image, _, T), _ = sequence(2)
    generator = torch.Generator().manual_seed(9)
    jumped = T.clone()
    jumped[:3, :3] = rotation_from_axis_angle(torch.tensor([0.0, 0.2, 0.0], dtype=torch.float64)) @ T[:3, :3]
    jumped[0, 3] += 0.1 * T[2, 3]
    there = synthesize_photograph(example_mesh(), jumped, CAMERA, SIZE, generator)[0]
    calls = []
    monkeypatch.setattr(following, "TRUSTED", 1.1)  # whatever the tracker says
    monkeypatch.setattr(following, "refine", lambda *args: calls.append(args) or refine(*args))
    follow = Follower(truck_registrar(), CAMERA)
    follow.start(image, T)
    result = follow(there)
    assert len(calls) == 1
    assert float(rotation_error(result.rotation, jumped[:3, :3])) < 4.0


@pytest.mark.parametrize("pose", [torch.eye(3), torch.full((4, 4), torch.nan), 2.0 * torch.eye(4)])
def test_start_refuses_what_is_not_a_pose(pose):
    with pytest.raises(InvalidInputError, match="pose"):
        Follower(truck_registrar(), CAMERA).start(torch.rand(3, 40, 60), pose)


def test_follower_loses_an_absent_object_and_finds_it_again():
    frames = sequence(2)
    follow = Follower(truck_registrar(), CAMERA)
    follow(*frames[0][:2])
    empty = procedural_background(SIZE, torch.Generator().manual_seed(5))
    assert not follow(empty).ok
    result = follow(frames[1][0])
    assert float(rotation_error(result.rotation, frames[1][2][:3, :3])) < 4.0
