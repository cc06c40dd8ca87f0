"""Focal lengths that a photograph contradicts."""

from functools import cache

import pytest
import torch

from curvireg_torch.geometry import camera_matrix, rotation_from_viewpoint, transform
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.registration import camera as camera_module
from curvireg_torch.registration.camera import focal_contradiction
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from tests._support.numbers import double, seeded
from tests._support.scenes import learned_registrar

SIZE = (360, 480)
FOCAL = 400.0


def camera(factor):
    return camera_matrix(factor * FOCAL, factor * FOCAL, 239.5, 179.5, dtype=torch.float64)


@cache
def near_photograph():
    """(3, H, W) and its box (4,): seen from nearby, so that perspective is strong."""
    mesh = example_mesh()
    R = rotation_from_viewpoint(40.0, 25.0, 0.0).double()
    ahead = double([0.0, 0.0, 2.6 * mesh_radius(mesh)])
    T = transform(R, ahead - R @ mesh_centre(mesh))
    return synthesize_photograph(mesh, T, camera(1.0), SIZE, seeded(0))


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.3])
def test_a_focal_length_that_the_photograph_contradicts_is_named_and_not_reliable(factor):
    image, box = near_photograph()
    result = learned_registrar()([image], box[None], camera(factor))[0]
    if factor == 1.0:
        assert result.reliable
        assert not result.warnings
        return
    assert result.confidence > 0.9
    assert not result.reliable
    assert [text for text in result.warnings if "shows a focal length of about" in text]
    shown = float(result.warnings[-1].split("about ")[1].split(" px")[0])
    assert shown == pytest.approx(FOCAL, rel=0.05)


def test_focal_lengths_of_several_photographs_are_compared_at_once(monkeypatch):
    image, box = near_photograph()
    given = []
    measure = camera_module.focal_gaps
    monkeypatch.setattr(camera_module, "focal_gaps", lambda *a: given.append(a) or measure(*a))
    for factor in (0.8, 1.0, 1.25):
        learned_registrar()([image], box[None], camera(factor))
    contours, crops = given[0][:2]
    cameras, T, index = (torch.cat([one[k] for one in given]) for k in (2, 3, 4))
    gaps, deviations = measure(contours, crops, cameras, T, index)
    alone = [float(measure(*one)[0]) for one in given]
    assert gaps.tolist() == pytest.approx(alone, abs=1e-5)
    assert gaps.tolist() == pytest.approx([0.223, 0.0, -0.223], abs=0.03)
    assert deviations[1] == torch.inf, "the first step is small: nobody looked further"
    assert float(deviations[0]) < 0.15


def test_contradictions_need_a_clear_focal_length_two_deviations_and_a_distance_that_matters():
    def named(gap, deviation, given=0.0):
        return focal_contradiction(500.0, gap, deviation, given_deviation=given) is not None

    assert named(0.21, 0.1)
    assert named(-0.21, 0.1)
    assert not named(0.19, 0.1)
    assert not named(0.6, 0.15), "not determined"
    assert named(0.2, 0.05)
    assert not named(0.2, 0.05, 0.1), "the camera is not known better"
    assert named(-0.15, 0.01)
    assert not named(-0.13, 0.01), "a distance that is less than 15 % off"
    assert "1000 px, not the camera's 500 px" in str(focal_contradiction(500.0, 0.69315, 0.01))
