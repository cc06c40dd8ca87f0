import pytest
import torch
from scipy.spatial.transform import Rotation

from curvireg_torch import geometry as g
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.mesh.mesh import extreme_points
from curvireg_torch.synthetic import example_mesh

K = g.camera_matrix(800.0, 820.0, 310.0, 255.0, dtype=torch.float64)


def true_poses(spread: float, count: int = 25) -> list[tuple[torch.Tensor, ...]]:
    """(hull, centre, view R, R, t, box) of objects 3 to 12 radii away, ``spread`` (tangent) off the axis."""
    mesh = example_mesh()
    mesh.apply_translation([3.0, -2.0, 1.0])  # the centre is far from the origin
    centre, radius, hull = mesh_centre(mesh), mesh_radius(mesh), extreme_points(mesh)
    generator = torch.Generator().manual_seed(0)
    poses = []
    for i in range(count):
        u = torch.rand(3, generator=generator, dtype=torch.float64)
        ray = torch.stack([spread * (2 * u[0] - 1), spread * (2 * u[1] - 1), torch.ones_like(u[0])])
        ray = ray / ray.norm() * (3.0 + 9.0 * u[2]) * radius
        view = torch.from_numpy(Rotation.random(random_state=i).as_matrix())
        R = g.rotation_towards(ray) @ view
        t = ray - R @ centre
        poses.append((hull, centre, view, R, t, g.projected_boxes(hull, g.transform(R, t), K)))
    return poses


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_pose_from_box_recovers_the_true_pose(spread: float) -> None:
    for hull, centre, view, R, t, box in true_poses(spread):
        assert float((g.pose_from_box(hull, R, box, K, allocentric=False)[1] - t).norm() / t.norm()) < 1e-6
        found_R, found_t = g.pose_from_box(hull, view, box, K)
        distance = (R @ centre + t).norm()
        assert float(g.rotation_error(found_R, R)) < 0.01
        assert float((found_R @ centre + found_t - R @ centre - t).norm() / distance) < 1e-4


def test_pose_from_box_does_not_depend_on_the_rest_of_the_batch() -> None:
    """One of the boxes is so wide that the steps do not converge."""
    poses = true_poses(0.3, 4)
    views, boxes = torch.stack([pose[2] for pose in poses]), torch.stack([pose[5] for pose in poses])
    boxes[1] = torch.tensor([-2000.0, 100.0, 2600.0, 130.0])
    batch = g.pose_from_box(poses[0][0], views, boxes, K.expand(4, 3, 3))
    for i in range(4):
        alone = g.pose_from_box(poses[0][0], views[i : i + 1], boxes[i : i + 1], K[None])
        assert torch.equal(alone[0][0], batch[0][i])
        assert torch.equal(alone[1][0], batch[1][i])


def test_rotation_towards_is_the_smallest_rotation_onto_the_ray() -> None:
    rays = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rays[:, 2] = rays[:, 2].abs() + 0.1
    R = g.rotation_towards(rays)
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(50, 3, 3), rtol=0, atol=1e-12)
    unit = rays / rays.norm(dim=1, keepdim=True)
    torch.testing.assert_close(R[:, :, 2], unit, rtol=0, atol=1e-12)
    angle = torch.rad2deg(torch.acos(unit[:, 2]))
    torch.testing.assert_close(g.rotation_error(R, torch.eye(3, dtype=torch.float64).expand(50, 3, 3)), angle)


def test_pose_from_box_keeps_the_object_in_front_of_the_camera() -> None:
    cube = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
    box = torch.tensor([-1e5, -1e5, 1e5, 1e5], dtype=torch.float64) + K[:2, 2].repeat(2)
    nearest = 1.05 * 3.0**0.5  # extents of the cube
    straight = g.pose_from_box(cube, torch.eye(3, dtype=torch.float64), box, K, allocentric=False)[1]
    assert float(straight[2]) == pytest.approx(nearest, rel=1e-6)
    rotated = g.rotation_from_viewpoint(20.0, 30.0, 10.0).double()
    assert float(g.pose_from_box(cube, rotated, box, K, allocentric=False)[1][2]) > nearest - 1e-6
