"""Focal lengths that are fitted with the pose."""

from dataclasses import replace

import pytest
import torch

from curvireg_torch import camera_matrix
from curvireg_torch.geometry import rotation_error
from curvireg_torch.geometry.cameras import projected
from curvireg_torch.registration import focal
from curvireg_torch.registration.contour_fit import ContourProblem
from curvireg_torch.registration.edges import EdgeCrops
from curvireg_torch.registration.inputs import image_item
from curvireg_torch.registration.least_squares import apply_twist, project
from curvireg_torch.registration.poses import Poses
from curvireg_torch.synthetic import example_mesh, synthesize_photograph
from tests._support.scenes import SIZE, learned_registrar, scene, truck_registrar

NEAR = camera_matrix(150.0, 150.0, 119.5, 89.5)  # a wide angle, from where perspective is strong


def near_scene():
    """image, box and true pose of the object of scene 0, at a distance of three radii."""
    T = scene(0)[2].clone()
    centre = truck_registrar().describer.centre
    T[:3, 3] += torch.tensor([0.0, 0.0, 3.0 * truck_registrar().describer.radius]) - (
        T[:3, :3] @ centre + T[:3, 3]
    )
    image, box = synthesize_photograph(
        example_mesh(), T, NEAR, SIZE, torch.Generator().manual_seed(5)
    )
    return image, box, T


def fitting_problem(image, box, K, factor=1):
    describer = truck_registrar().describer
    crops = EdgeCrops.cut([image], box[None], 0.1)
    return ContourProblem.of(
        describer.contours, crops, K[None], torch.zeros(1, dtype=torch.long), factor=factor
    )


def test_a_longer_focal_length_keeps_place_and_size_of_the_image():
    T = scene(0)[2][None].clone()
    centre = truck_registrar().describer.centre
    T[0, 0, 3] += 0.3  # off the axis
    zoom = torch.tensor([0.01], dtype=torch.float64)
    moved = focal._moved_away(T, zoom, centre)
    longer = focal.scaled_cameras(NEAR[None], zoom)
    assert longer[0].tolist() == [
        [150.0 * zoom.exp().item(), 0, 119.5],
        [0, 150.0 * zoom.exp().item(), 89.5],
        [0, 0, 1],
    ]
    before, after = (
        projected(centre[None], pose, K)[0] for pose, K in ((T, NEAR[None]), (moved, longer))
    )
    torch.testing.assert_close(before, after)
    turn = focal._motion_with_focal_length(T, centre)[0, :3] * 0.01
    assert float(rotation_error(moved[0, :3, :3], T[0, :3, :3])) == pytest.approx(
        float(torch.rad2deg(turn.norm())), rel=0.02
    )


def test_derivative_by_the_focal_length():
    image, box, T = near_scene()
    problem = fitting_problem(image, box, NEAR)
    T = apply_twist(
        T[None], torch.tensor([[0.05, 0.1, 0.0, 0.02, 0.0, 0.0]]).double(), problem.centre
    )
    state = problem.state(T)
    step = torch.tensor([1e-5], dtype=torch.float64)

    def pixels(sign):
        moved = focal._moved_away(T, sign * step, problem.centre)
        K = focal.scaled_cameras(problem.K, sign * step)
        return project(state.points.model, state.points.normals, moved, K, problem.centre)[0]

    numeric = ((pixels(1.0) - pixels(-1.0)) / (2.0 * step) * state.points.normals).sum(dim=-1)
    uv, J = project(state.points.model, state.points.normals, T, problem.K, problem.centre)
    valid = state.points.valid
    found = focal._by_focal_length(problem, state, uv, J)
    torch.testing.assert_close(found[valid], numeric[valid], atol=1e-4, rtol=1e-4)
    assert float(found[valid].abs().max()) > 1.0


@pytest.mark.parametrize("wrong", [0.75, 1.35])
def test_strong_perspective_shows_the_focal_length(wrong):
    image, box, T = near_scene()
    guess = focal.scaled_cameras(NEAR[None], torch.tensor([wrong]).double().log())[0]
    problem = fitting_problem(image, box, guess)
    start = focal._moved_away(T[None], torch.tensor([wrong]).double().log(), problem.centre)
    fit = focal.fit_focal_length(
        problem, start, focal.FocalPrior.usual(guess[None], SIZE), focal.FULL_RADII
    )
    assert wrong * float(fit.log_zoom.exp()) == pytest.approx(1.0, abs=0.06)
    assert float(rotation_error(fit.state.T[0, :3, :3], T[:3, :3])) < 1.5
    information, _ = focal.focal_information(fit.problem, fit.state, 2.0)
    assert float(information.variance.sqrt()) < 0.2


def test_a_narrow_prior_holds_the_focal_length():
    image, box, T = near_scene()
    guess = focal.scaled_cameras(NEAR[None], torch.tensor([1.35]).double().log())[0]
    problem = fitting_problem(image, box, guess)
    none = torch.zeros(1, dtype=torch.float64)
    prior = focal.FocalPrior(none, 1e-4, none - 1.0, none + 1.0)
    fit = focal.fit_focal_length(problem, T[None], prior, focal.FULL_RADII)
    assert float(fit.log_zoom) == pytest.approx(0.0, abs=1e-3)


def test_covariance_and_deviation_of_the_focal_length():
    image, box, T = near_scene()
    describer = truck_registrar().describer
    crops = EdgeCrops.cut([image], box[None], 0.1)
    one = torch.zeros(1, dtype=torch.long)
    poses = Poses.at(
        T[None], NEAR[None], describer.centre, one, torch.zeros(1, dtype=torch.float64)
    )
    poses = replace(poses, covariance=torch.zeros(1, 6, 6, dtype=torch.float64))
    item = replace(image_item(image, box, NEAR), focal_deviation=0.05, camera_source="exif")
    covariance, deviation = focal.focal_covariance(describer, crops, poses, item)
    assert 0.0 < deviation < 0.05, "the prior and the photograph together"
    z = float((T[:3, :3] @ describer.centre + T[:3, 3])[2])
    assert float(covariance[0, 5, 5].sqrt()) == pytest.approx(deviation * z, rel=0.5), (
        "the distance grows with it"
    )
    assert int(torch.linalg.matrix_rank(covariance[0])) == 1


def test_an_unknown_camera_is_estimated():
    image, box, T = near_scene()
    result = learned_registrar()([image], box[None])[0]
    assert result.camera.source == "estimated"
    assert torch.equal(result.camera.matrix, result.projection[1])
    ratio = float(result.camera.matrix[0, 0] / NEAR[0, 0])
    assert abs(ratio - 1.0) < max(0.1, 3.0 * result.camera.focal_deviation)
    assert float(rotation_error(result.rotation, T[:3, :3])) < 5.0
    position = result.transform[:3, 3] / ratio - T[:3, 3]
    assert float(position.norm()) < 0.1 * float(T[:3, 3].norm()), (
        "the distance is proportional to the focal length"
    )
    given = learned_registrar()([image], box[None], NEAR)[0]
    assert (given.camera.source, given.camera.focal_deviation) == ("given", 0.0)
    assert result.standard_deviations[1][2] > given.standard_deviations[1][2]


def test_fields_of_view_are_across_the_longer_side():
    wide, tall = (focal.possible_cameras(size) for size in ((480, 640), (640, 480)))
    assert [float(K[0, 0]) for K in wide] == [float(K[0, 0]) for K in tall]
    assert tall[0][:2, 2].tolist() == [239.5, 319.5]
    assert float(wide[2][0, 0]) == pytest.approx(320 / 0.41421356, rel=1e-6)
