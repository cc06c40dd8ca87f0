"""A turn that contours leave open to first order, and that a finite one determines."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
import trimesh

from curvireg_torch.evidence import Evidence
from curvireg_torch.fitting.measured_fit import measure_contours
from curvireg_torch.registration import judging
from curvireg_torch.registration.hypotheses import Hypotheses, by_contours
from curvireg_torch.registration.photograph import as_photographs
from curvireg_torch.registration.stages import describe, rank
from curvireg_torch.synthetic import synthesize_photograph
from tests._support import CAMERA, SIZE, double, seeded
from tests._support.scenes import bank_around, exact_registrar, seen_from


def bottle(depth):
    """1.6 wide and ``depth`` deep, with a narrow neck."""
    body = trimesh.creation.cylinder(radius=1.0, height=1.2, sections=64)
    body.apply_scale((0.8, 0.5 * depth, 1.0))
    neck = trimesh.creation.cylinder(radius=0.2, height=0.5, sections=48)
    neck.apply_translation((0.0, 0.0, 0.85))
    return trimesh.util.concatenate([body, neck])


def mug():
    """With a handle behind it, so that it is not round about the middle of its box."""
    body = trimesh.creation.cylinder(radius=1.0, height=1.6, sections=96)
    handle = trimesh.creation.box((0.5, 0.25, 0.9))
    handle.apply_translation((1.15, 0.0, 0.0))
    return trimesh.util.concatenate([body, handle])


def flat_disc():
    """Two turns of it are open."""
    body = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=64)
    body.apply_scale((1.0, 0.3, 1.0))
    return body


MESHES = {
    "flat bottle": (lambda: bottle(1.0), 0.0, 0.0),
    "deep bottle": (lambda: bottle(1.5), 0.0, 0.0),
    "round bottle": (lambda: bottle(1.6), 0.0, 0.0),
    "mug": (mug, 270.0, 0.0),
    "flat disc": (flat_disc, 0.0, 0.0),
}
"""By name: a mesh, and azimuth and elevation from which it is photographed."""


@cache
def photographed(name):
    """The registrar of a mesh, a pose, and a photograph and its box."""
    mesh, azimuth, elevation = MESHES[name]
    registrar = exact_registrar(bank_around(mesh(), 30, [0]))
    T = seen_from(registrar.bank.mesh.surface, azimuth, elevation, 4.5)
    image, box = synthesize_photograph(registrar.bank.mesh, T, CAMERA, SIZE, seeded(0))
    return registrar, T, image, box


def turn_deviations(name):
    """Standard deviations (3,) in rad of the true rotation, the largest last, by contours alone and
    with finite turns."""
    registrar, T, image, box = photographed(name)
    (item,) = as_photographs([image], [box], CAMERA)
    block = rank(registrar, [item], describe(registrar, [item]))
    none = torch.zeros(1, dtype=torch.long)
    pose = Hypotheses.at(T[None], CAMERA[None], registrar.describer.centre, none, none)
    fit = by_contours(measure_contours, registrar.describer, block.crops, pose)
    pose = pose.with_fit(fit, registrar.describer.centre)
    after = judging.with_determined_turns(registrar, block, block.crops, pose)
    found = [torch.linalg.eigvalsh(one.covariance[0, :3, :3]).sqrt() for one in (pose, after)]
    assert torch.linalg.eigvalsh(after.covariance[0]).min() > 0.0
    return found


def test_a_finite_turn_determines_what_contours_leave_open_to_first_order():
    before, after = turn_deviations("flat bottle")
    assert before[2] > 3.0
    assert 0.1 < after[2] < 0.3
    assert torch.allclose(after[:2], before[:2], rtol=0.05)


@pytest.mark.parametrize(
    "name",
    [
        "deep bottle",  # its outline changes little
        "mug",  # turned about the middle of its box, it would be shifted
        "flat disc",
    ],
)
def test_other_turns_stay_open(name):
    before, after = turn_deviations(name)
    assert before[2] > 3.0
    assert (before[1] > 3.0) == (name == "flat disc")
    assert after.equal(before)


def test_the_turn_of_a_body_of_revolution_is_not_measured(monkeypatch):
    """It is none of its pose, whatever a score says of it."""
    evidence = replace(Evidence.zeros(3), similarity=double([1.0, 0.5, 0.5]))
    monkeypatch.setattr(
        judging, "with_evidence", lambda _, __, poses: replace(poses, evidence=evidence)
    )
    before, after = turn_deviations("round bottle")
    assert before[2] > 3.0
    assert after.equal(before)


def test_a_turn_that_only_this_photograph_leaves_open_stays_open(monkeypatch):
    """Edges that the mesh predicts are missing: perhaps it is another object."""
    monkeypatch.setattr(judging, "ideal_covariance", lambda *_: 0.01 * torch.eye(6).double()[None])
    before, after = turn_deviations("flat bottle")
    assert after.equal(before)


@pytest.mark.parametrize(("left", "is_determined"), [(0.8, True), (0.865, False)])
def test_the_smaller_loss_at_30_degrees_gives_the_deviation(monkeypatch, left, is_determined):
    """exp(-loss) is the density of a Gaussian at 30 degrees, relative to its middle."""
    similarity = double([1.0, left, 0.5])
    evidence = replace(Evidence.zeros(3), similarity=similarity)
    monkeypatch.setattr(
        judging, "with_evidence", lambda _, __, poses: replace(poses, evidence=evidence)
    )
    before, after = turn_deviations("flat bottle")
    if is_determined:
        density = math.exp(-0.5 * (math.radians(30.0) / float(after[2])) ** 2)
        assert density == pytest.approx(math.exp(-10.0 * (1.0 - left)), rel=0.01)
    else:
        assert after.equal(before)


def test_registrations_contain_finite_turns():
    registrar, _, image, box = photographed("flat bottle")
    (found,) = registrar([image], [box], CAMERA)
    assert found.confidence_features["undetermined"] < 1.0
