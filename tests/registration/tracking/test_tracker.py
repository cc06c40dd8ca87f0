"""The tracker: each measurement alone on drawn objects, and together on generated sequences."""

import pytest
import torch
import trimesh

from curvireg_torch import camera_matrix
from curvireg_torch.errors import LostObjectError
from curvireg_torch.geometry import rotation_error, rotation_from_axis_angle
from curvireg_torch.geometry.cameras import transform
from curvireg_torch.mesh.mesh import extreme_points, mesh_centre, mesh_radius
from curvireg_torch.registration.tracking import Tracker, tracker
from curvireg_torch.rendering import make_renderer
from curvireg_torch.synthetic import example_mesh
from tests._support.scenes import CAMERA
from tests.registration.test_following import sequence

K = camera_matrix(500.0, 500.0, 159.5, 119.5, dtype=torch.float64)
SIZE = (240, 320)
START = transform(
    rotation_from_axis_angle(torch.tensor([0.4, 0.5, 0.1], dtype=torch.float64)),
    torch.tensor([0.0, 0.0, 6.0], dtype=torch.float64),
)


def make_tracker(mesh):
    return Tracker(make_renderer(mesh), extreme_points(mesh), centre=mesh_centre(mesh), radius=mesh_radius(mesh))


def cube():
    return trimesh.creation.box((1.0, 1.4, 0.8))


def moved(T, angles, shift):
    out = T.clone()
    out[:3, :3] = rotation_from_axis_angle(torch.tensor(angles, dtype=torch.float64)) @ T[:3, :3]
    out[:3, 3] += torch.tensor(shift, dtype=torch.float64)
    return out


def drawn(T, inside=(0.8, 0.2, 0.2), outside=(0.2, 0.5, 0.3)):
    """A cube of one colour on a background of another."""
    mask = make_renderer(cube()).render(T[None], K, SIZE)[0] > 0
    return torch.where(mask, torch.tensor(inside)[:, None, None], torch.tensor(outside)[:, None, None])


def shift_in_pixels(T, truth):
    """Mean distance of the cube's corners in the image."""
    corners = torch.from_numpy(cube().vertices)
    uv = [(corners @ P[:3, :3].mT + P[:3, 3]) @ K.mT for P in (T, truth)]
    return float((uv[0][:, :2] / uv[0][:, 2:] - uv[1][:, :2] / uv[1][:, 2:]).norm(dim=1).mean())


@pytest.fixture
def only(monkeypatch):
    """Weights of all measurements but one become 0, that of edges nearly so."""

    def choose(name):
        for other in ("EDGES", "REGIONS", "POINTS", "KEYFRAME"):
            if other != name:
                monkeypatch.setattr(tracker, other, 1e-9 if other == "EDGES" else 0.0)

    return choose


@pytest.mark.parametrize("name", ["EDGES", "REGIONS"])
def test_each_measurement_alone_moves_the_outline_onto_a_plain_cube(only, name):
    only(name)
    truth = moved(START, [0.0, 0.0, 0.03], [0.03, -0.02, 0.0])
    follow = make_tracker(cube())
    follow.start(drawn(START), K, START)
    assert shift_in_pixels(START, truth) > 3.0
    assert shift_in_pixels(follow.track(drawn(truth), K).T[0], truth) < 0.5


def test_region_equations_pull_towards_the_object():
    """The cube is 2 px further right than the pose: the step is a translation to the right, of about as much."""
    follow = make_tracker(cube())
    follow.start(drawn(START), K, START)
    step = 2.0 * 6.0 / 500.0
    truth = moved(START, [0.0, 0.0, 0.0], [step, 0.0, 0.0])
    frame = follow._frame(drawn(truth), K, START[None])
    outline = follow._render(frame, START[None])
    A, b = follow._equations(frame, outline, START[None], [], 6.0)
    x = torch.linalg.solve(A[:, 3:, 3:], b[:, 3:])[0]
    assert float(x[0]) == pytest.approx(step, rel=0.3)
    assert float(x[1:].abs().max()) < 0.3 * step


def test_prediction_goes_on_at_constant_velocity():
    (_, _, first), (_, _, second), (_, _, third) = frames = sequence(3)
    follow = make_tracker(example_mesh())
    follow.start(frames[0][0], CAMERA, first)
    assert [T.shape for T in follow.predictions()] == [(1, 4, 4)]
    follow.accept(follow.measure(frames[1][0], CAMERA, second))
    predicted, last = follow.predictions()
    assert torch.equal(last[0], second)
    assert float(rotation_error(predicted[0, :3, :3], third[:3, :3])) < 0.01
    step, error = (float((T[:3, 3] - third[:3, 3]).norm()) for T in (second, predicted[0]))
    assert error < 0.1 * step


def test_tracker_follows_a_generated_sequence():
    frames = sequence(8)
    follow = make_tracker(example_mesh())
    follow.start(frames[0][0], CAMERA, frames[0][2])
    for image, _, T in frames[1:]:
        found = follow.track(image, CAMERA)
        follow.accept(found)
        assert float(rotation_error(found.T[0, :3, :3], T[:3, :3])) < 2.0
        assert float((found.T[0, :3, 3] - T[:3, 3]).norm() / T[:3, 3].norm()) < 0.02
        assert found.confidence > 0.5
        assert all(0.0 <= value <= 1.0 for value in found.features.values())
        R = found.T[0, :3, :3]
        assert float((R @ R.mT - torch.eye(3)).abs().max()) < 1e-12


def test_confidence_falls_where_the_object_is_absent():
    frames = sequence(2)
    follow = make_tracker(example_mesh())
    follow.start(frames[0][0], CAMERA, frames[0][2])
    there = follow.track(frames[1][0], CAMERA)
    noise = torch.rand(frames[1][0].shape, generator=torch.Generator().manual_seed(1))
    absent = follow.track(noise, CAMERA)
    assert absent.confidence < 0.2 < 0.5 < there.confidence


def test_pose_outside_the_image_is_lost():
    follow = make_tracker(cube())
    outside = moved(START, [0.0, 0.0, 0.0], [5.0, 0.0, 0.0])
    with pytest.raises(LostObjectError, match="outside"):
        follow.start(drawn(START), K, outside)
    behind = START.clone()
    behind[2, 3] = -6.0
    with pytest.raises(LostObjectError):
        follow.start(drawn(START), K, behind)
