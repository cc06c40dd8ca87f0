"""Following: a generated sequence of rotating and approaching objects, and a frame in which the object is absent."""

import torch

from curvireg_torch.geometry import rotation_error, rotation_from_axis_angle
from curvireg_torch.registration import Follower
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


def test_follower_predicts_at_constant_velocity():
    follow = Follower(truck_registrar(), CAMERA)
    (_, _, first), (_, _, second), (_, _, third) = sequence(3)
    follow._poses = [first, second]
    predicted, last = follow._predictions()
    assert torch.equal(last, second)
    assert float(rotation_error(predicted[:3, :3], third[:3, :3])) < 0.01
    assert float((predicted[:3, 3] - third[:3, 3]).norm()) < 0.1 * float((second[:3, 3] - third[:3, 3]).norm())


def test_follower_loses_an_absent_object_and_finds_it_again():
    frames = sequence(2)
    follow = Follower(truck_registrar(), CAMERA)
    follow(*frames[0][:2])
    empty = procedural_background(SIZE, torch.Generator().manual_seed(5))
    assert not follow(empty).ok
    result = follow(frames[1][0])
    assert float(rotation_error(result.rotation, frames[1][2][:3, :3])) < 4.0
