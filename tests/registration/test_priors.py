"""Pose priors in a registration: views, search, contour fit and report keep within what is known of the pose."""

import math

import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import (
    rotation_error,
    rotation_from_axis_angle,
    rotation_towards,
    viewpoint_from_rotation,
)
from curvireg_torch.geometry.pose_prior import PosePrior
from curvireg_torch.matching import Ranking
from curvireg_torch.registration.hypotheses import start_hypotheses
from curvireg_torch.registration.inputs import ImageItem
from curvireg_torch.registration.priors import BatchPriors
from tests._support.scenes import CAMERA, scene, truck_bank, truck_registrar

IMAGE, BOX, T = scene(0)
ONE, TRUTH = ([IMAGE], BOX[None], CAMERA), T[:3, :3]
AZIMUTH = float(viewpoint_from_rotation(TRUTH)[0])


@pytest.fixture(scope="module")
def registrar():
    return truck_registrar()


def around(azimuth, tolerance):
    return PosePrior(azimuth=((azimuth - tolerance) % 360, (azimuth + tolerance) % 360))


def test_prior_that_excludes_nothing_changes_nothing(registrar):
    free = registrar(*ONE)[0]
    with_prior = registrar(*ONE, prior=PosePrior(azimuth=(0, 360)))[0]
    assert torch.equal(with_prior.rotation, free.rotation)
    assert with_prior.confidence == free.confidence
    assert with_prior.prior_contradiction is None


def test_prior_around_the_truth_keeps_the_right_pose(registrar):
    result = registrar(*ONE, prior=around(AZIMUTH, 30.0))[0]
    assert float(rotation_error(result.rotation, TRUTH)) < 5.0
    assert result.prior_contradiction is None


@pytest.mark.parametrize("pipeline", [{}, {"contours": False}, {"contours": False, "search": False}], ids=str)
def test_every_hypothesis_lies_within_hard_limits(pipeline):
    prior = around(AZIMUTH + 180.0, 40.0)
    result = truck_registrar(**pipeline)(*ONE, prior=prior)[0]
    for hypothesis in result.hypotheses:
        assert float(prior.excess(hypothesis.rotation)) <= 3.0
    assert result.prior_contradiction == "better outside"


def test_result_at_a_limit_is_reported(registrar):
    result = registrar(*ONE, prior=PosePrior(azimuth=(AZIMUTH + 4.0, AZIMUTH + 60.0)))[0]
    assert result.prior_contradiction in ("at the limit", "better outside")


def test_each_photograph_has_its_own_prior(registrar):
    priors = [None, around(AZIMUTH + 180.0, 40.0)]
    free, limited = registrar([IMAGE, IMAGE], BOX.repeat(2, 1), CAMERA, prior=priors)
    assert float(rotation_error(free.rotation, TRUTH)) < 5.0
    assert float(priors[1].excess(limited.rotation)) <= 3.0
    with pytest.raises(InvalidInputError, match="prior: expected a PosePrior, or a list of 2"):
        registrar([IMAGE, IMAGE], BOX.repeat(2, 1), CAMERA, prior=priors[:1])


def test_prior_that_leaves_no_view_fails_that_photograph_alone(registrar):
    nowhere = PosePrior(elevation=(85, 90), theta=(90, 91))
    failed, fine = registrar([IMAGE, IMAGE], BOX.repeat(2, 1), CAMERA, prior=[nowhere, None])
    assert not failed.ok
    assert "no view of the bank" in str(failed.error)
    assert fine.ok


def limits_of(prior, box=(100.0, 60.0, 140.0, 100.0)):
    item = ImageItem(torch.rand(3, 180, 240), torch.tensor(box), CAMERA, prior)
    return BatchPriors([item], truck_bank())


def test_batch_priors_rotate_views_towards_the_box():
    """The limit holds in the photograph's own camera, which sees a box at the border 25 degrees off its axis."""
    bank, box = truck_bank(), (200.0, 20.0, 238.0, 60.0)
    ray = torch.linalg.solve(CAMERA, torch.tensor([219.0, 40.0, 1.0], dtype=torch.float64))
    R = rotation_towards(ray) @ bank.rotations[5].double()
    log_prior = limits_of(PosePrior(rotation=R, within=0.1), box).log_prior(bank)[0]
    distances = rotation_error(bank.rotations.double(), bank.rotations[5].double())
    assert float(log_prior[5]) == 0.0
    assert bool((log_prior[distances > 7.7] == -torch.inf).all())
    assert bool((log_prior[distances < 7.5] == 0.0).all())


def test_batch_priors_keep_fitted_poses_up_to_three_degrees_outside():
    eye = torch.eye(3, dtype=torch.float64)
    hypotheses = start_hypotheses(ranking_of(1), truck_bank(), count=1)
    kept = []
    for degrees in (12.9, 13.1):
        T = torch.eye(4, dtype=torch.float64)[None].clone()
        T[0, :3, :3] = rotation_from_axis_angle(torch.tensor([0.0, 0.0, math.radians(degrees)], dtype=torch.float64))
        kept.append(bool(limits_of(PosePrior(rotation=eye, within=10.0)).keeps(hypotheses, T)))
    assert kept == [True, False]


def ranking_of(allowed):
    """Equal scores of all views, of which the first ``allowed`` are allowed."""
    n = len(truck_bank())
    return Ranking(torch.zeros(1, n), torch.arange(n)[None].flip(1), {}, (torch.arange(n) < allowed)[None])


def test_start_hypotheses_come_from_allowed_views():
    assert start_hypotheses(ranking_of(1), truck_bank(), count=5).view.tolist() == [0]


DISTANCE = float(T[:3, 3].norm())  # of the origin, which is near the centre


def centre_distances(result, registrar):
    centre = registrar.describers[0].centre
    return [float((h.rotation @ centre + h.translation).norm()) for h in result.hypotheses]


@pytest.mark.parametrize("pipeline", [{}, {"contours": False}, {"contours": False, "search": False}], ids=str)
@pytest.mark.parametrize("factors", [(0.5, 0.7), (1.4, 2.0)])
def test_every_hypothesis_lies_at_an_allowed_distance(pipeline, factors):
    registrar = truck_registrar(**pipeline)
    near, far = (factor * DISTANCE for factor in factors)
    result = registrar(*ONE, prior=PosePrior(distance=(near, far)))[0]
    for distance in centre_distances(result, registrar):
        assert 0.97 * near <= distance <= 1.03 * far
    assert result.prior_contradiction == "better outside"
    assert result.confidence >= 0.9 or pipeline == {}
    assert not result.reliable


def test_distance_that_holds_the_truth_changes_nothing(registrar):
    free = registrar(*ONE)[0]
    limited = registrar(*ONE, prior=PosePrior(distance=(0.8 * DISTANCE, 1.2 * DISTANCE)))[0]
    assert torch.equal(limited.translation, free.translation)
    assert limited.prior_contradiction is None


def test_distance_at_a_limit_is_reported(registrar):
    (found, *_) = centre_distances(registrar(*ONE)[0], registrar)
    for limits, contradiction in (
        ((0.5 * found, 1.02 * found), None),
        ((0.5 * found, 1.005 * found), "at the limit"),
        ((0.98 * found, 2.0 * found), None),
        ((0.995 * found, 2.0 * found), "at the limit"),
    ):
        assert registrar(*ONE, prior=PosePrior(distance=limits))[0].prior_contradiction == contradiction


def test_batch_priors_keep_fitted_poses_up_to_three_percent_too_far():
    hypotheses, limits = (
        start_hypotheses(ranking_of(1), truck_bank(), count=1),
        limits_of(PosePrior(distance=(1.0, 2.0))),
    )
    kept = []
    for away in (0.969, 0.972, 2.055, 2.065):
        kept.append(bool(limits.keeps(hypotheses, pose_at(away))))
    assert kept == [False, True, True, False]


def pose_at(away):
    """(1, 4, 4) pose whose centre is so far away, off the optical axis."""
    pose = torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, :3, 3] = away * torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64) - truck_centre()
    return pose


@pytest.mark.parametrize(("away", "outside"), [(0.89, True), (0.92, False), (2.19, False), (2.21, True)])
def test_box_that_asks_for_a_distance_far_outside_is_reported(registrar, away, outside):
    limits, best = limits_of(PosePrior(distance=(1.0, 2.0))), start_hypotheses(ranking_of(1), truck_bank(), count=1)
    noted = limits.note(registrar(*ONE)[0], best, pose_at(1.5), pose_at(away))
    assert noted.prior_contradiction == ("better outside" if outside else None)


def test_batch_priors_move_poses_along_the_ray_to_an_allowed_distance():
    hypotheses, limits = (
        start_hypotheses(ranking_of(1), truck_bank(), count=1),
        limits_of(PosePrior(distance=(1.0, 2.0))),
    )
    for away, expected in ((0.5, 1.0), (1.5, 1.5), (9.0, 2.0)):
        torch.testing.assert_close(limits.at_distance(hypotheses, pose_at(away)), pose_at(expected))


def truck_centre():
    return torch.from_numpy(truck_bank().mesh.bounds.mean(axis=0))
