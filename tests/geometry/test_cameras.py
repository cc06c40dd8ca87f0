import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from curvireg_torch import geometry as g
from curvireg_torch.geometry.cameras import point_in_cameras, pose_around
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.mesh.mesh import extreme_points
from curvireg_torch.synthetic import example_mesh
from tests._support import double, eye, refused, uniform
from tests._support.poses import rotations

K = g.camera_matrix(800.0, 820.0, 310.0, 255.0)


def test_project_points_agrees_with_opencv():
    X = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    rotation = np.array([0.3, -0.8, 0.2])
    t = np.array([0.2, -0.1, 5.0])
    expected = cv2.projectPoints(X, rotation, t, K.numpy(), None)[0][:, 0]
    T = g.transform(
        torch.from_numpy(Rotation.from_rotvec(rotation).as_matrix()), torch.from_numpy(t)
    )
    points = torch.from_numpy(X)
    assert_allclose(g.project_points(points, T, K), expected, atol=1e-9)
    box = g.projected_boxes(points, T, K)
    assert_allclose(box, [*expected.min(0), *expected.max(0)], atol=1e-9)
    mixed = g.project_points(points.float(), T, K.float())
    assert mixed.dtype == torch.float64
    assert_allclose(mixed, expected, atol=1e-3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        single = g.project_points(points.float(), T.float(), K.float())
    assert_allclose(single, expected, atol=1e-3)
    for wrong, message in ((X, "got ndarray"), (torch.ones(40, 2), r"shape \(\*, 3\)")):
        with refused(f"points: expected .*{message}"):
            g.project_points(wrong, T, K)


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_pose_from_box_recovers_the_true_pose(spread):
    """Of objects 3 to 12 radii away, ``spread`` (tangent) off the axis."""
    mesh = example_mesh()
    mesh.apply_translation([3.0, -2.0, 1.0])  # the centre is far from the origin
    centre = mesh_centre(mesh)
    radius = mesh_radius(mesh)
    hull = extreme_points(mesh)
    u = uniform(25, 3)
    rays = F.pad(spread * (2.0 * u[:, :2] - 1.0), (0, 1), value=1.0)
    rays = F.normalize(rays, dim=1) * (3.0 + 9.0 * u[:, 2:]) * radius
    views = rotations(25, 0)
    R = g.rotation_towards(rays) @ views
    boxes = g.projected_boxes(hull, pose_around(R, rays, centre), K)
    found_R, found_t = g.pose_from_box(hull, views, boxes, K)
    assert g.rotation_error(found_R, R).max() < 0.01
    off = found_R @ centre + found_t - rays
    assert (off.norm(dim=1) / rays.norm(dim=1)).max() < 1e-4


def test_pose_from_box_keeps_the_object_in_front_of_the_camera():
    cube = torch.cartesian_prod(*[double([-1.0, 1.0])] * 3)
    box = double([-1e5, -1e5, 1e5, 1e5]) + K[:2, 2].repeat(2)
    nearest = 1.05 * 3.0**0.5  # extents of the cube
    straight = g.pose_from_box(cube, eye(3), box, K)[1]
    assert float(straight[2]) == pytest.approx(nearest, rel=1e-6)
    rotated = g.rotation_from_viewpoint(20.0, 30.0, 10.0)
    assert float(g.pose_from_box(cube, rotated, box, K)[1][2]) > nearest - 1e-6


def test_a_pose_around_a_point_has_it_at_the_place():
    R = g.rotation_from_viewpoint(double([30.0, 80.0]), 20.0, 5.0)
    point = double([0.3, -0.2, 0.5])
    places = double([[0.1, 0.2, 3.0], [-0.4, 0.0, 5.0]])
    T = pose_around(R, places, point)
    assert_close(point_in_cameras(T, point), places)
    assert_close(point_in_cameras(T[1], point), places[1])
    homogeneous = torch.cat([point, torch.ones(1).double()])
    assert_close((T @ homogeneous)[:, :3], places)
