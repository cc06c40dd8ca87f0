"""Pose priors in a registration: views, search, contour fit and report keep within what is known of the pose."""

from dataclasses import replace

import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_error, viewpoint_from_rotation
from curvireg_torch.geometry.pose_prior import PosePrior
from tests._support.scenes import CAMERA, scene, truck_registrar

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


def test_soft_limits_move_the_ranking_and_exclude_no_view(registrar):
    matcher = registrar.matcher
    query = matcher.query([IMAGE], BOX[None])
    prior = replace(around(AZIMUTH + 180.0, 40.0), softness=30.0)
    log_prior = prior.log_prior(registrar.bank.rotations.double())[None]
    ranked = matcher.rank(query, log_prior)
    assert bool(ranked.allowed.all())
    assert torch.equal(matcher.rank(query, torch.zeros_like(log_prior)).scores, matcher.rank(query).scores)
    assert float(ranked.prior_ratio) < 1.0


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
