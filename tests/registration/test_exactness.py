"""How exact a pose is, in two numbers and in words."""

from dataclasses import replace

import pytest
import torch

from curvireg_torch.calibration import CALIBRATION
from curvireg_torch.fitting.exactness import Exactness, exactness_of
from curvireg_torch.geometry import (
    rotation_error,
    rotation_from_axis_angle,
    rotation_from_viewpoint,
)
from curvireg_torch.geometry.cameras import rotation_towards
from curvireg_torch.registration.camera import principal_covariance
from curvireg_torch.registration.hypotheses import placed
from curvireg_torch.visualization.words import remarks
from tests._support import double, eye, seeded
from tests._support.hypotheses import placed_at
from tests._support.results import registration

COVARIANCE = torch.diag(double([0.02, 0.05, 0.03, 1.0, 2.0, 8.0]).square())
CENTRE = double([20.0, -30.0, 10.0])


def pose():
    """Rotation, translation, allocentric rotation and distance, in mm."""
    R = rotation_from_viewpoint(30.0, 20.0, 5.0).double()
    t = double([80.0, -40.0, 600.0])
    position = R @ CENTRE + t
    return R, t, rotation_towards(position[None])[0].T @ R, float(position.norm())


def check_fraction(are_within):
    assert are_within.double().mean() == pytest.approx(0.9, abs=0.02)


def test_nine_in_ten_errors_are_within(monkeypatch):
    monkeypatch.setitem(CALIBRATION, "radius", {"rotation": 1.0, "distance": 1.0})
    R, t, allocentric, distance = pose()
    exactness = exactness_of(COVARIANCE, R, t, allocentric, distance)
    generator = seeded(0)
    normal = torch.randn(4000, 6, generator=generator, dtype=torch.float64)
    errors = normal * COVARIANCE.diagonal().sqrt()
    turns = rotation_from_axis_angle(errors[:, :3])
    centres = turns @ R @ CENTRE + t + errors[:, 3:]
    check_fraction(torch.rad2deg(errors[:, :3].norm(dim=1)) < exactness.rotation_deg)
    away = 100.0 * (centres.norm(dim=1) / distance - 1.0).abs()
    check_fraction(away < exactness.distance_percent)
    seen = rotation_towards(centres).mT @ turns @ R
    check_fraction(rotation_error(seen, allocentric) < exactness.allocentric_deg)


def test_a_principal_point_that_is_not_known_leaves_the_allocentric_rotation_exact():
    R, t, allocentric, distance = pose()
    T = eye(4)[None]
    T[0, :3, :3] = R
    T[0, :3, 3] = t
    poses = placed(placed_at(T, CENTRE), T, CENTRE)
    unknown = principal_covariance(poses, (180, 240), CENTRE)[0]
    exactness = exactness_of(unknown, R, t, allocentric, distance)
    assert exactness.rotation_deg > 8.0
    assert exactness.allocentric_deg < 0.01
    assert exactness_of(COVARIANCE + unknown, R, t, allocentric, distance).rotation_deg > 8.0


def test_a_turn_that_nothing_determines_is_left_out():
    R, t, allocentric, distance = pose()
    known = torch.diag(double([1e-4, 1e-4, 9.0, 1.0, 1.0, 1.0]))
    assert exactness_of(known, R, t, allocentric, distance).rotation_deg < 2.0
    nothing = torch.diag(double([9.0, 9.0, 9.0, 1.0, 1.0, 1.0]))
    unknown = exactness_of(nothing, R, t, allocentric, distance)
    assert unknown.rotation_deg == CALIBRATION["radius"]["rotation"] * 180.0


def test_words_have_one_digit():
    for degrees, percent, words in (
        (2.6, 1.9, "3 degrees and 2 %"),
        (1.2, 0.34, "1 degree and 0.3 %"),
        (14.0, 0.01, "10 degrees and 0.1 %"),
    ):
        assert Exactness(degrees, percent, 1.0).words == f"to about {words} of the distance"


def test_results_say_how_exact_they_are_and_what_the_distance_holds_for():
    covariance = torch.diag(double([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3]))
    result = registration(covariance, confidence=0.95)
    document = result.to_dict()
    assert document["exactness"]["words"] == result.exactness.words
    (line,) = remarks(document)
    assert line.startswith("exact to about 0.8 degrees and 1 % of the distance")
    assert "the mesh has the object's size and the focal length is right" in line
    (line,) = remarks({**document, "camera_source": "estimated"})
    assert "use allocentric_rotation" in line
    for degrees, said in ((0.96, "1 degree as"), (1.6, "2 degrees as"), (11.2, "10 degrees as")):
        exactness = {**document["exactness"], "allocentric_deg": degrees}
        (line,) = remarks({**document, "camera_source": "estimated", "exactness": exactness})
        assert line.startswith(f"exact to about {said} seen along the ray to the object")
    assert document["allocentric_rotation"] == result.allocentric_rotation.tolist()
    assert replace(result, probabilities=(0.5,)).to_dict()["exactness"] is None
