"""Contours of a mesh: the same in any unit, and nothing of what lies behind the camera."""

from functools import cache

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry import camera_matrix, rotation_from_viewpoint, transform
from curvireg_torch.rendering import render_depth
from curvireg_torch.rendering.contours import (
    MAX_OCCLUDING,
    ContourPoints,
    MeshContours,
    _Columns,
    _evenly_chosen,
    _spread_evenly,
)
from curvireg_torch.synthetic import example_mesh
from tests._support import double, eye

K = camera_matrix(220.0, 220.0, 63.5, 63.5)


def stairs(unit):
    """Two boxes of different heights that touch, and a flat sphere beside them."""
    parts = [trimesh.creation.box((2.0, 1.2, height)) for height in (0.5, 0.9)]
    parts[1].apply_translation((0.0, 1.2, 0.2))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    ball.apply_translation((1.6, 0.0, 0.1))
    mesh = trimesh.util.concatenate([*parts, ball])
    mesh.apply_scale(unit)
    return mesh


@cache
def poses():
    """(4, 4, 4) around the mesh in units, 5 to 8 away."""
    T = []
    for azimuth, elevation, distance in ((20, 25, 5), (110, 40, 6), (200, 10, 7), (290, 60, 8)):
        R = rotation_from_viewpoint(azimuth, elevation, 10.0)
        T.append(transform(R, double([0.0, 0.0, distance])))
    return torch.stack(T)


@cache
def contour_points(unit):
    T = poses().clone()
    T[:, :3, 3] *= unit
    return MeshContours(stairs(unit)).points(T, K[None], 128)


@pytest.mark.parametrize("unit", [1e-4, 80.0])
def test_contours_do_not_depend_on_the_unit(unit):
    one = contour_points(1.0)
    same = contour_points(unit)
    agree = (one.valid == same.valid) & (one.outline == same.outline)
    assert agree.double().mean() > 0.98
    both = one.valid & same.valid
    apart = (same.model / unit - one.model).norm(dim=-1)[both]
    assert (apart < 1e-3).double().mean() > 0.95
    turned = (same.normals * one.normals).sum(dim=-1).abs()[both]
    assert (turned > 0.99).double().mean() > 0.95


def test_every_view_has_creases_beside_its_occluding_contours():
    points = contour_points(1.0)
    creases = points.valid[:, MAX_OCCLUDING:].sum(dim=1)
    assert creases.min() > 10
    assert not points.outline[:, MAX_OCCLUDING:].any()


@pytest.mark.parametrize("unit", [1e-4, 1.0, 80.0])
def test_edges_that_reach_behind_the_camera_have_no_points(unit):
    """A long bar that passes the camera: only whole edges in front of it count."""
    bar = trimesh.creation.box((0.4, 0.4, 10.0))
    plate = trimesh.creation.box((1.0, 1.0, 0.1))
    plate.apply_translation((0.0, 0.0, 6.0))
    mesh = trimesh.util.concatenate([bar, plate])
    mesh.apply_scale(unit)
    T = transform(eye(3), unit * double([0.5, 0.0, 0.0]))[None]
    points = MeshContours(mesh).points(T, K[None], 128)
    model = points.model[points.valid] / unit
    assert len(model) > 20
    depth = model[:, 2]
    assert depth.min() > 4.9, "the far end of the bar, and the plate"


@pytest.mark.parametrize("inside_out", [False, True])
def test_normals_of_outlines_point_away_from_the_object(inside_out):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    if inside_out:
        ball.invert()
    T = transform(eye(3), double([0.0, 0.0, 300.0]))[None]
    points = MeshContours(ball).points(T, K[None], 128)
    model = points.model[points.outline]
    radial = model[:, :2] / model[:, :2].norm(dim=1, keepdim=True)
    cosine = (points.normals[points.outline] * radial).sum(dim=1)
    assert len(model) > 100
    assert cosine.min() > np.cos(np.radians(2.0)), "of the sphere, not of its facets"


def test_the_simplified_mesh_is_drawn_where_the_mesh_is():
    """A dented ball, which is not simplified for nothing, away from the origin."""
    mesh = trimesh.creation.icosphere(subdivisions=5)
    mesh.vertices *= 1.0 + 0.1 * np.sin(4.0 * mesh.vertices).mean(axis=1, keepdims=True)
    mesh.apply_translation((3.0, -2.0, 1.0))
    T = poses().clone()
    T[:, :3, 3] -= T[:, :3, :3] @ torch.tensor(mesh.bounding_box.centroid)
    renderer = MeshContours(mesh).renderer(128)
    assert len(renderer._faces) <= 2500 < len(mesh.faces)
    simple = renderer.render(T, K[None], (128, 128))
    exact = render_depth(mesh, T, K, (128, 128))
    assert ((simple > 0) != (exact > 0)).sum() < 0.01 * float((exact > 0).sum())
    both = (simple > 0) & (exact > 0)
    assert (simple - exact)[both].abs().quantile(0.95) < 0.01


def test_a_pose_that_is_no_number_has_no_points_and_leaves_the_others_theirs():
    contours = MeshContours(stairs(1.0))
    T = poses().clone()
    alone = contours.points(T[1:], K[None], 128)
    T[0] = torch.nan
    together = contours.points(T, K[None], 128)
    assert not together.valid[0].any()
    assert torch.equal(together.valid[1:], alone.valid)
    assert torch.equal(together.model[1:][alone.valid], alone.model[alone.valid])


def test_points_of_a_pose_are_the_same_to_the_bit_among_others():
    contours = MeshContours(example_mesh())
    azimuths = torch.arange(500, dtype=torch.float64)
    distance = double([0.0, 0.0, 4.0 * contours.radius])
    T = transform(rotation_from_viewpoint(0.72 * azimuths, 20.0), distance.expand(500, 3))
    together = contours.points(T, K[None], 128)
    alone = ContourPoints.cat([contours.points(one, K[None], 128) for one in T.split(1)])
    assert together.model.equal(alone.model)
    assert together.normals.equal(alone.normals)


def test_places_lie_evenly_along_the_edges_of_each_pose_and_kind():
    """Occluding contours of lengths 1, 0, 3 in the first view, none in the second, 2 and 2 in the
    third; creases of length 4 in the first and 1 in the second view."""
    length = torch.tensor([1.0, 0.0, 3.0, 4.0, 1.0, 2.0, 2.0, 0.0])
    chain = torch.tensor([0, 0, 0, 1, 3, 4, 4, 4])
    number, fraction, valid = _spread_evenly(length, chain, 3, _Columns(4, 2, length.device))
    number = number.view(3, 6)
    assert number[[0, 2], :4].tolist() == [[0, 2, 2, 2], [5, 5, 6, 6]]
    assert number[:2, 4:].tolist() == [[3, 3], [4, 4]]
    expected = torch.tensor([[1 / 2, 1 / 6, 1 / 2, 5 / 6], [1 / 4, 3 / 4, 1 / 4, 3 / 4]])
    torch.testing.assert_close(fraction[[0, 2], :4], expected)
    torch.testing.assert_close(fraction[:2, 4:], torch.tensor([[1 / 4, 3 / 4]] * 2))
    on_contour = valid[:, :4]
    on_crease = valid[:, 4:]
    assert on_contour.all(dim=1).tolist() == [True, False, True]
    assert on_crease.all(dim=1).tolist() == [True, True, False]
    assert not on_contour[1].any()
    assert not on_crease[2].any()


def test_points_are_chosen_evenly_of_each_kind():
    """Of four candidates two and of three one."""
    seen = torch.tensor([[1, 1, 1, 1, 0, 1, 1], [0, 0, 1, 0, 0, 0, 0]], dtype=torch.bool)
    columns = [_Columns(*counts, seen.device) for counts in ((4, 3), (2, 1))]
    index, is_point = _evenly_chosen(seen, *columns)
    assert is_point.tolist() == [[True] * 3, [True, False, False]]
    assert index[is_point].tolist() == [0, 2, 5, 9]
    assert index[1, 1:].tolist() == [7, 7]
