"""The tracker: each measurement alone on drawn objects and in closed form, and together on
generated sequences."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch import camera_matrix
from curvireg_torch.errors import LostObjectError
from curvireg_torch.fitting import regions
from curvireg_torch.fitting.contour_problem import ContourProblem
from curvireg_torch.fitting.edges import CROP_SIZE
from curvireg_torch.fitting.flow import Frame, Keyframe, track_points
from curvireg_torch.fitting.least_squares import INLIER_SCALE, PointMatches, fit_points, pixels
from curvireg_torch.fitting.regions import (
    HALF_RATE_COUNT,
    SECTORS,
    RegionModel,
    colour_bins,
    line_posterior,
)
from curvireg_torch.fitting.texture_fit import surface_corners
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.geometry.cameras import project_points, transform
from curvireg_torch.mesh.mesh import extreme_points
from curvireg_torch.registration import tracking
from curvireg_torch.registration.tracking import FLOW_SCALES, Tracker
from curvireg_torch.rendering import make_renderer
from curvireg_torch.rendering.contours import MeshContours
from curvireg_torch.synthetic import example_mesh
from tests._support import (
    CAMERA,
    check_near,
    double,
    eye,
    refused,
    seeded,
    sequence,
    uniform,
    zeros,
)
from tests.fitting.cube import cube, pose

K = camera_matrix(500.0, 500.0, 159.5, 119.5)
SIZE = (240, 320)
START = pose([0.4, 0.5, 0.1], [0.0, 0.0, 6.0])
WINDOW_K = double([[[400.0, 0, 127.5], [0, 400.0, 127.5], [0, 0, 1]]])
ZERO = zeros(3)


def make_tracker(mesh):
    return Tracker(MeshContours(mesh), extreme_points(mesh))


def started():
    """A tracker of the cube in a first frame."""
    follow = make_tracker(cube())
    follow.start(drawn(START), K, START)
    return follow


def measured():
    """A tracker of the cube, and what it measures in the first frame again."""
    follow = started()
    return follow, follow.measure(drawn(START), K, START)


def moved(T, angles, shift):
    out = T.clone()
    out[:3, :3] = rotation_from_axis_angle(double(angles)) @ T[:3, :3]
    out[:3, 3] += double(shift)
    return out


def drawn(T):
    """A cube of one colour on a background of another."""
    mask = make_renderer(cube()).render(T[None], K, SIZE)[0] > 0
    inside, outside = torch.tensor([[0.8, 0.2, 0.2], [0.2, 0.5, 0.3]])[..., None, None]
    return torch.where(mask, inside, outside)


def shift_in_pixels(T, truth):
    """Mean distance of the cube's corners in the image."""
    corners = torch.from_numpy(cube().vertices)
    shift = project_points(corners, T, K) - project_points(corners, truth, K)
    return float(shift.norm(dim=1).mean())


def plate(x=0.0, y=0.0):
    """A plate with a print, 160 px wide, moved in its plane by (x, y): its window, pose, and
    depth."""
    T = transform(eye(3), double([x, y, 5.0]))[None]
    size = (CROP_SIZE, CROP_SIZE)
    depth = make_renderer(trimesh.creation.box((2.0, 2.0, 0.01))).render(T, WINDOW_K, size)
    rough = torch.rand(1, 1, 64, 64, generator=seeded(0))
    smooth = torch.nn.functional.interpolate(rough, size=1024, mode="bicubic")[0, 0]
    v, u = torch.meshgrid(torch.arange(256.0), torch.arange(256.0), indexing="ij")
    shift = 80.0 * torch.tensor([x, y])
    # shifts of whole pixels
    look = smooth[(v - shift[1] + 300).long(), (u - shift[0] + 300).long()]
    grey = (255 * torch.where(depth[0, 0] > 0, look, 0.5)).clamp(0, 255).byte().numpy()
    return framed(grey), T, depth


def framed(grey):
    """A frame of which only the grey picture is looked at."""
    none = None
    return Frame(none, grey, WINDOW_K, none)


def keyframe_of(window, T, depth):
    uv, model = surface_corners(window.grey, depth, T, WINDOW_K, quality=0.01, inside=3)
    return Keyframe(window.grey, T, uv, model)


def test_flow_finds_the_corners_of_a_moved_plate_and_their_pose():
    window, T, depth = plate()
    other, truth, _ = plate(0.15, -0.1)  # 12 px and -8 px
    flow = track_points(keyframe_of(window, T, depth), other, T, levels=3)
    there = flow.weight[0] > 0
    assert there.double().mean() > 0.8
    error = (flow.uv - pixels(flow.model, truth, WINDOW_K)).norm(dim=-1)[0, there]
    assert error.median() < 0.1
    assert torch.allclose(fit_points(flow, T, WINDOW_K, ZERO, FLOW_SCALES), truth, atol=5e-3)
    assert flow.inlier_ratio(truth, WINDOW_K) > 0.8
    assert flow.inlier_ratio(T, WINDOW_K) < 0.05  # 14 px beside


def test_flow_back_starts_at_the_corner():
    """After a motion of 60 px that is predicted, it finds it without a high pyramid."""
    window, T, depth = plate(-0.3)
    other, truth, _ = plate(0.45)
    flow = track_points(keyframe_of(window, T, depth), other, truth, levels=1)
    assert (flow.weight[0] > 0).double().mean() > 0.8


def test_flow_that_does_not_lead_back_is_left_out_and_a_uniform_surface_has_none():
    """The right half of the plate is covered by another print."""
    window, T, depth = plate()
    covered = framed(window.grey.copy())
    covered.grey[:, 128:] = np.random.default_rng(0).integers(0, 255, (256, 128))
    flow = track_points(keyframe_of(window, T, depth), covered, T, levels=1)
    right = flow.model[0, :, 0] > 0.1
    assert (flow.weight[0, right] > 0).double().mean() < 0.2
    assert (flow.weight[0, ~right] > 0).double().mean() > 0.7
    bare = framed(np.full_like(window.grey, 90))
    flow = track_points(keyframe_of(bare, T, depth), window, T, levels=1)
    assert (flow.uv.shape, flow.inlier_ratio(T, WINDOW_K)) == ((1, 0, 2), 0.0)
    assert torch.equal(fit_points(flow, T, WINDOW_K, ZERO, FLOW_SCALES), T)


@pytest.mark.parametrize("weight", [0.0, 1e6], ids=["edges", "colours"])
def test_each_measurement_alone_moves_the_outline_onto_a_plain_cube(monkeypatch, weight):
    """Without points, and without colours or nearly without edges."""
    for name, value in (("POINT_WEIGHT", 0.0), ("KEYFRAME_WEIGHT", 0.0), ("REGION_WEIGHT", weight)):
        monkeypatch.setattr(tracking, name, value)
    truth = moved(START, [0.0, 0.0, 0.03], [0.03, -0.02, 0.0])
    follow = started()
    assert shift_in_pixels(START, truth) > 3.0
    assert shift_in_pixels(follow.track(drawn(truth), K).state.T[0], truth) < 0.5


def test_a_step_follows_edges_the_end_of_the_colours_and_corners(monkeypatch):
    follow = started()
    found = follow.measure(drawn(START), K, moved(START, [0.0, 0.0, 0.01], [0.01, 0.0, 0.0]))
    given = []
    monkeypatch.setattr(
        ContourProblem, "selected_step", lambda *x: given.extend(x) or torch.zeros(1, 6)
    )
    model = uniform(1, 9, 3) - 0.5
    uv = pixels(model, START[None], found.frame.K)
    corners = PointMatches(model, uv, torch.ones(1, 9).double())
    follow._step(found.frame, found.state, corners, 4.0)
    _, points, _, J, _, (equations,) = given
    colours = follow._colours(found.frame, found.state, J[:, points.outline[0]], 4)
    matches = corners.measurements(found.state.T, found.frame.K, follow.centre, INLIER_SCALE)
    for together, *parts in zip(equations, colours.equations(), matches.equations(), strict=True):
        assert torch.allclose(together, sum(parts))
        assert all((part != 0).any() for part in parts)


def test_colours_are_learned_in_a_band_on_both_sides_of_the_outline(monkeypatch):
    follow, found = measured()
    learned = []
    monkeypatch.setattr(follow._regions, "learn", lambda *given: learned.extend(given))
    follow.accept(found)
    _, lines, _, inside = learned
    silhouette = follow._silhouette(found.frame, found.state)
    across = ((lines - silhouette.uv[:, None]) * silhouette.normals[:, None]).sum(dim=2)
    band = double(tracking.LEARNED_BAND)
    assert torch.allclose(across, torch.cat([-band, band]).expand_as(across))
    assert not inside[across > 0].any()
    assert inside[across < 0].double().mean() > 0.9


def test_directions_lead_from_the_centre_of_the_object():
    """Which is not that of the crop: the camera's principal point is 20 px to the left."""
    follow, found = measured()
    shifted = found.frame.K.clone()
    shifted[0, 0, 2] += 20.0
    silhouette = follow._silhouette(replace(found.frame, K=shifted), found.state)
    middle = pixels(follow.centre[None, None], START[None], shifted)[0]
    away = torch.stack([silhouette.directions.cos(), silhouette.directions.sin()], dim=1)
    arms = silhouette.uv - middle
    assert torch.allclose(away * arms.norm(dim=1, keepdim=True), arms)
    assert (silhouette.normals * arms).sum(dim=1).min() > 0.0


def test_tracker_follows_a_generated_sequence_until_the_object_is_absent():
    frames = sequence(8)
    follow = make_tracker(example_mesh())
    follow.start(frames[0][0], CAMERA, frames[0][2])
    for image, _, T in frames[1:]:
        found = follow.track(image, CAMERA)
        follow.accept(found)
        check_near(found.state.T[0], T, degrees=2.0, share=0.02)
        R = found.state.T[0, :3, :3]
        assert found.confidence > 0.5
        assert all(0.0 <= value <= 1.0 for value in found.features.values())
        assert (R @ R.mT - eye(3)).abs().max() < 1e-12
        C = follow.covariance(found)
        assert torch.linalg.eigvalsh(C).min() > 0
        assert torch.rad2deg(C[:3, :3].diagonal().sqrt()).max() < 20.0
    noise = torch.rand(frames[0][0].shape, generator=seeded(1))
    assert follow.track(noise, CAMERA).confidence < 0.2


def test_covariance_counts_edges_near_the_pose():
    """At a pose that is 5 % too near, all edges are some 4 px inside its outline."""
    follow = started()
    near = moved(START, [0.0, 0.0, 0.0], [0.0, 0.0, -0.3])
    there, beside = (follow.covariance(follow.measure(drawn(START), K, T)) for T in (START, near))
    assert there.isfinite().all()
    assert beside.isnan().all()


def test_pose_outside_the_image_is_lost():
    follow = make_tracker(cube())
    for shift in ([5.0, 0.0, 0.0], [0.0, 0.0, -12.0]):
        with refused("outside", LostObjectError):
            follow.start(drawn(START), K, moved(START, [0.0, 0.0, 0.0], shift))


def test_posterior_is_that_of_bayes():
    ratio = double([[0.3, -0.2, 0.9, -1.1, 0.4]])
    p = double([0.3, 0.1, 1.0, -0.1]).softmax(dim=0)
    d = double([-1.5, -0.5, 0.5, 1.5])
    mean, variance = line_posterior(ratio, 2)
    assert float(mean) == pytest.approx(float((p * d).sum()), abs=1e-6)
    assert float(variance) == pytest.approx(float((p * d**2).sum() - (p * d).sum() ** 2), abs=1e-6)


def halves():
    """A red left half and a green right half; pixel columns of 8 lines that point to the right from
    the middle."""
    colours = torch.zeros(1, 3, 16, 16)
    colours[:, 0, :, :8], colours[:, 1, :, 8:] = 1.0, 1.0
    y, x = torch.meshgrid(torch.arange(4.0, 12.0), torch.arange(16.0), indexing="ij")
    return colour_bins(colours), torch.stack([x, y], dim=-1)


RIGHT = torch.zeros(8)
"""Directions of the lines."""


def learned():
    """A model of a red object on the left of a green background."""
    bins, uv = halves()
    model = RegionModel()
    model.learn(bins, uv, RIGHT, uv[..., 0] < 8)
    return model


def test_log_ratio_has_the_sign_of_the_learned_colours():
    bins, uv = halves()
    model = learned()
    ratio = model.log_ratio(bins, uv, RIGHT)
    assert (ratio[:, :8] > 0.3).all()
    assert (ratio[:, 8:] < -0.3).all()
    # nothing learned there but the mean of all directions
    opposite = model.log_ratio(bins, uv, RIGHT + math.pi)
    assert (opposite[:, :8] > 0.1).all()
    assert (opposite[:, :8] < ratio[:, :8]).all()
    assert (model.log_ratio(bins, uv - 100.0, RIGHT) == 0).all()


def test_histograms_move_by_the_rate_towards_new_colours():
    bins, uv = halves()
    model = learned()
    red = bins[0, 0]
    green = bins[0, 15]
    assert float(model._histograms[0, 0, red]) == 1.0
    model.learn(bins, uv, RIGHT, uv[..., 0] >= 8)  # the colours swap
    step = 0.2 * 64 / (64 + HALF_RATE_COUNT)
    assert float(model._histograms[0, 0, green]) == pytest.approx(step)
    assert float(model._histograms[0, 0, red]) == pytest.approx(1.0 - step)


def test_log_ratio_changes_evenly_between_the_middles_of_two_sectors():
    """Red and green are learned to the right: in the next sector, only their mean is known."""
    bins, uv = halves()
    model = learned()
    before, first, between, second, around = (
        float(model.log_ratio(bins, uv, RIGHT + part * 2.0 * math.pi / SECTORS)[0, 0])
        for part in (-1 / 3, 0.0, 1 / 3, 1.0, -SECTORS)
    )
    assert first > second + 0.1 > 0.2
    assert between == pytest.approx((2.0 * first + second) / 3.0, abs=1e-6)
    assert before == pytest.approx(between, abs=1e-5)
    assert around == first


def test_what_lies_outside_the_window_is_not_learned():
    bins, uv = halves()
    model = RegionModel()
    model.learn(bins, uv - 100.0, RIGHT, uv[..., 0] < 8)
    assert model._histograms.sum() == 0.0


def test_histograms_are_smoothed_along_each_channel():
    """What lies beyond the first and the last level counts as these."""
    counts = torch.rand(2, 3, 8, 8, 8, generator=seeded(0))
    expected = counts
    for axis in (2, 3, 4):
        levels = expected.unbind(axis)
        below = torch.stack([levels[0], *levels[:-1]], dim=axis)
        above = torch.stack([*levels[1:], levels[-1]], dim=axis)
        expected = 0.6 * expected + 0.2 * (below + above)
    assert torch.allclose(regions._smooth(counts.flatten(2)), expected.flatten(2))
