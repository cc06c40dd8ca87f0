"""Pose priors in a registration: views, search, contour fit and report keep within what is known of
the pose."""

import math

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch import camera_matrix
from curvireg_torch.geometry import (
    Camera,
    rotation_error,
    rotation_from_axis_angle,
    rotation_towards,
    viewpoint_from_rotation,
)
from curvireg_torch.geometry.cameras import point_in_cameras
from curvireg_torch.geometry.pose_prior import PosePrior
from curvireg_torch.registration.block import Limits
from curvireg_torch.registration.hypotheses import Hypotheses
from curvireg_torch.registration.photograph import Photograph
from tests._support import (
    CAMERA,
    answer_of,
    double,
    eye,
    learned_answer,
    learned_registrar,
    refused,
    scene,
    slow_after,
    truck_bank,
    truck_registrar,
)
from tests._support.hypotheses import placed_at

IMAGE, BOX, T = scene(0)
ONE = ([IMAGE], BOX[None], CAMERA)
TRUTH = T[:3, :3]
AZIMUTH = float(viewpoint_from_rotation(TRUTH)[0])


def around(azimuth, tolerance):
    return PosePrior(azimuth=((azimuth - tolerance) % 360, (azimuth + tolerance) % 360))


def test_each_photograph_has_its_own_prior_which_may_leave_no_view():
    registrar = truck_registrar()
    priors = [None, around(AZIMUTH + 180.0, 40.0), PosePrior(elevation=(85, 90), theta=(90, 91))]
    free, limited, failed = registrar([IMAGE] * 3, BOX.repeat(3, 1), CAMERA, prior=priors)
    assert rotation_error(free.rotation, TRUTH) < 5.0
    for hypothesis in limited.hypotheses:
        assert priors[1].excess(hypothesis.rotation) <= 3.0
    assert limited.prior_contradiction == "better outside"
    assert not failed.ok
    assert "no view of the bank" in str(failed.error)
    with refused("prior: expected a PosePrior, or a list of 3"):
        registrar([IMAGE] * 3, BOX.repeat(3, 1), CAMERA, prior=priors[:1])


def limits_of(prior, box=(100.0, 60.0, 140.0, 100.0)):
    item = Photograph(torch.rand(3, 180, 240), torch.tensor(box), Camera(CAMERA), prior)
    return Limits(item, truck_bank())


def test_limits_hold_in_the_camera_of_the_photograph():
    """It sees a box at the border 25 degrees off its axis."""
    bank = truck_bank()
    box = (200.0, 20.0, 238.0, 60.0)
    ray = torch.linalg.solve(CAMERA, double([219.0, 40.0, 1.0]))
    R = rotation_towards(ray) @ bank.rotations[5].double()
    allowed = limits_of(PosePrior(rotation=R, within=0.1), box).allowed()
    distances = rotation_error(bank.rotations.double(), bank.rotations[5].double())
    assert allowed[5]
    assert not allowed[distances > 7.7].any()
    assert allowed[distances < 7.5].all()


def pose_at(away=1.5, degrees=0.0):
    """A pose whose centre is so far away, off the optical axis, rotated about the axis."""
    describer = truck_registrar().describer
    pose = eye(4)[None]
    pose[0, :3, :3] = rotation_from_axis_angle(double([0.0, 0.0, math.radians(degrees)]))
    pose[0, :3, 3] = away * double([0.6, 0.0, 0.8]) - pose[0, :3, :3] @ describer.centre
    return placed_at(pose, describer.centre)


def test_fitted_poses_up_to_three_degrees_outside_are_kept_and_within_a_degree_of_a_limit_lie_at_it():  # noqa: E501
    limits = limits_of(PosePrior(rotation=eye(3), within=10.0))
    for degrees, is_kept, words in (
        (8.9, True, None),
        (9.1, True, "at the limit"),
        (12.9, True, "at the limit"),
        (13.1, False, "at the limit"),
    ):
        pose = pose_at(degrees=degrees)
        assert bool(limits.keeps(pose)) == is_kept
        assert limits.contradiction(pose, pose_at(), better_outside=False) == words


# Limits of which one moves a rotation out of another
COMBINED = PosePrior(azimuth=(20.0, 40.0), elevation=(50.0, 70.0), theta=(-5.0, 5.0))


def test_poses_are_turned_into_all_limits_about_their_centre():
    limits = limits_of(COMBINED)
    describer = truck_registrar().describer
    rotation = truck_bank().rotations.double()[::7]
    view = torch.arange(len(rotation))
    boxes = torch.tensor([200.0, 20.0, 238.0, 60.0]).expand(len(view), 4)
    cameras = CAMERA.expand(len(view), 3, 3)
    distance = torch.ones(len(view))
    poses = Hypotheses.in_boxes(describer, boxes, cameras, rotation, distance, view, 0.0 * view)
    moved = limits.moved_inside(poses)
    assert COMBINED.excess(moved.T[:, :3, :3]).max() < 0.01
    assert limits.moved_inside(moved).T.equal(moved.T)
    before, after = (point_in_cameras(T, describer.centre) for T in (poses.T, moved.T))
    assert_close(before, after)


@pytest.mark.parametrize("seed", slow_after(1, range(4)))
def test_no_hypothesis_exceeds_combined_limits_by_more_than_the_fit_may(seed):
    """In a wide camera, whose ray through the box is not that through the object's centre."""
    image, box, _ = scene(seed)
    K = camera_matrix(90.0, 90.0, 200.0, 150.0)
    prior = PosePrior(azimuth=(20.0, 40.0), elevation=(20.0, 40.0), theta=(-40.0, 40.0))
    for registrar, tolerance in ((truck_registrar(contours=False), 0.01), (truck_registrar(), 3.0)):
        for hypothesis in answer_of(registrar, image, box, K, prior=prior).hypotheses:
            assert prior.excess(hypothesis.rotation) <= tolerance


@pytest.mark.parametrize("turned", slow_after(1, [180.0, 120.0]))
def test_only_rival_outside_tells_whether_a_tight_right_hint_is_wrong(turned):
    """A hint within which no other view lies is no reason for doubt, and one on the far side is
    contradicted."""
    registrar = learned_registrar()
    tight = registrar(*ONE, prior=PosePrior(rotation=TRUTH, within=6.0))[0]
    assert rotation_error(tight.rotation, TRUTH) < 5.0
    assert tight.prior_contradiction is None
    assert tight.confidence > 0.5
    assert tight.confidence >= learned_answer().confidence - 0.1
    wrong = registrar(*ONE, prior=around(AZIMUTH + turned, 20.0))[0]
    assert wrong.prior_contradiction == "better outside"
    assert not wrong.reliable


DISTANCE = float(T[:3, 3].norm())  # of the origin, which is near the centre


@pytest.mark.parametrize(
    ("pipeline", "factors"), [({}, (0.5, 0.7)), ({"contours": False}, (1.4, 2.0))], ids=str
)
def test_every_hypothesis_lies_at_an_allowed_distance(pipeline, factors):
    registrar = truck_registrar(**pipeline)
    near, far = (factor * DISTANCE for factor in factors)
    result = registrar(*ONE, prior=PosePrior(distance=(near, far)))[0]
    for hypothesis in result.hypotheses:
        assert 0.97 * near <= hypothesis.distance <= 1.03 * far
    assert result.prior_contradiction == "better outside"
    assert not result.reliable


def test_limits_on_the_distance_keep_contradict_and_move_poses():
    """Fitted poses up to 3 % too far are kept, and others move along their ray; a box may ask for
    10 % more."""
    limits = limits_of(PosePrior(distance=(1.0, 2.0)))
    for away, is_kept in ((0.969, False), (0.972, True), (2.055, True), (2.065, False)):
        assert bool(limits.keeps(pose_at(away))) == is_kept
    for away, is_right in ((0.89, False), (0.92, True), (2.19, True), (2.21, False)):
        words = limits.contradiction(pose_at(1.5), pose_at(away), better_outside=False)
        assert words == (None if is_right else "better outside")
    for away, expected in ((0.5, 1.0), (1.5, 1.5), (9.0, 2.0)):
        assert_close(limits.moved_inside(pose_at(away)).T, pose_at(expected).T)
