import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry import camera_matrix
from curvireg_torch.rendering import make_renderer
from curvireg_torch.rendering.contours import MeshContours
from curvireg_torch.rendering.visibility import FaceTests, RayCaster
from curvireg_torch.rendering.zbuffer import DeviceRenderer
from curvireg_torch.synthetic import example_mesh, random_pose
from tests._support import double, seeded, uniform

MESHES = {
    "truck": example_mesh,
    "sphere": lambda: trimesh.creation.icosphere(subdivisions=3),
    "torus": lambda: trimesh.creation.torus(1.0, 0.4),
    "open": lambda: trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], [[0, 1, 2], [1, 3, 2]], process=False
    ),
}


def poses_of(mesh, size, count):
    generator = seeded(0)
    K = camera_matrix(2.5 * size, 2.4 * size, 0.5 * size, 0.45 * size, dtype=torch.float64)
    T = [random_pose(mesh, K, (size, size), generator) for _ in range(count)]
    return torch.stack(T), K


@pytest.mark.parametrize("name", MESHES)
def test_face_tests_see_what_rays_hit(name):
    """99.5 % of the rays, all or those that are wanted; the others graze a face."""
    mesh = MESHES[name]()
    given = np.array(mesh.vertices), np.array(mesh.faces)
    T, _ = poses_of(mesh, 64, 6)
    rays = 0.4 * uniform(6, 500, 2).float() - 0.2
    for wanted in (None, rays[..., 0] > 0.0):
        expected, found = (
            surface.seen_from(T[:, :3, :3], T[:, :3, 3])(rays, wanted)
            for surface in (RayCaster(*given), FaceTests(*given, torch.device("cpu")))
        )
        is_hit = expected.isfinite() | found.isfinite()
        agrees = torch.isclose(found, expected, rtol=1e-4, atol=0.0)[is_hit]
        assert len(agrees) > 50
        assert agrees.float().mean() >= 0.995


def test_contours_do_not_depend_on_the_batch(monkeypatch):
    monkeypatch.setattr("curvireg_torch.rendering.contours._visibility", FaceTests)
    contours = MeshContours(example_mesh())
    T, K = poses_of(example_mesh(), 64, 4)
    together = contours.points(T, K[None], 64)
    monkeypatch.setattr("curvireg_torch.rendering.contours.EDGES_AT_A_TIME", 1)
    monkeypatch.setattr("curvireg_torch.rendering.visibility.TESTS_AT_A_TIME", 1)
    alone = contours.points(T, K[None], 64)
    assert torch.equal(alone.valid, together.valid)
    torch.testing.assert_close(alone.model, together.model, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", MESHES)
def test_depth_of_the_device_is_that_of_rays(name):
    mesh = MESHES[name]()
    T, K = poses_of(mesh, 96, 3)
    expected = make_renderer(mesh, "embree").render(T, K, (90, 100))
    depth = DeviceRenderer(mesh, "cpu").render(T, K, (90, 100))
    both = (depth > 0) & (expected > 0)
    assert both.sum() > 150
    assert ((depth > 0) != (expected > 0)).sum() <= 0.002 * int(both.sum())
    error = (depth - expected)[both].abs()
    assert (error > 1e-3 * T[:, 2, 3].max()).float().mean() < 0.002


def test_views_that_the_camera_plane_cuts_are_drawn_by_rays():
    mesh = example_mesh()
    T, K = poses_of(mesh, 96, 2)
    contours = MeshContours(mesh)
    # the camera is within the object, which surrounds it
    T[0, :3, 3] = double([0.0, 0.0, 0.5 * contours.radius]) - T[0, :3, :3] @ contours.centre
    expected = make_renderer(mesh, "embree").render(T, K, (64, 64))
    assert (expected[0] > 0).all()
    depth = DeviceRenderer(mesh, "cpu").render(T, K, (64, 64))
    assert torch.equal(depth[0], expected[0])
    assert (depth[1] > 0).any()


def test_parallel_projections_are_drawn_by_rays():
    mesh = example_mesh()
    T, K = poses_of(mesh, 96, 1)
    K[0, 0] = K[1, 1] = 30.0 / MeshContours(mesh).radius  # px per unit
    given = T, K, (96, 96)
    expected = make_renderer(mesh, "embree").render(*given, orthographic=True)
    assert (expected > 0).sum() > 150
    assert torch.equal(DeviceRenderer(mesh, "cpu").render(*given, orthographic=True), expected)


def test_depth_does_not_depend_on_the_batch(monkeypatch):
    T, K = poses_of(example_mesh(), 96, 3)
    renderer = DeviceRenderer(example_mesh(), "cpu")
    together = renderer.render(T, K, (90, 100))
    monkeypatch.setattr("curvireg_torch.rendering.zbuffer.FRAGMENTS_AT_A_TIME", 1)
    assert torch.equal(renderer.render(T, K, (90, 100)), together)
