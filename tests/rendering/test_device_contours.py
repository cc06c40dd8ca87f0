import pytest
import torch
import trimesh

from curvireg_torch.geometry import camera_matrix
from curvireg_torch.rendering import make_renderer
from curvireg_torch.rendering.contours import MeshContours
from curvireg_torch.rendering.visibility import FaceTests
from curvireg_torch.rendering.zbuffer import DeviceRenderer
from curvireg_torch.synthetic import example_mesh, random_pose
from tests._support import double, seeded

MESHES = {
    "truck": example_mesh,
    "sphere": lambda: trimesh.creation.icosphere(subdivisions=3),
    "torus": lambda: trimesh.creation.torus(1.0, 0.4),
    "open": lambda: trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], [[0, 1, 2], [1, 3, 2]], process=False
    ),
}


def by_face_tests(mesh, monkeypatch):
    """Contours as other devices than a CPU find them, on the CPU."""
    with monkeypatch.context() as patched:
        patched.setattr("curvireg_torch.rendering.contours._visibility", FaceTests)
        contours = MeshContours(mesh)
        for size in (64, 128, 256):
            contours._level(size)
    return contours


def poses_of(mesh, size, count):
    generator = seeded(0)
    K = camera_matrix(2.5 * size, 2.4 * size, 0.5 * size, 0.45 * size, dtype=torch.float64)
    T = [random_pose(mesh, K, (size, size), generator) for _ in range(count)]
    return torch.stack(T), K


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize(("size", "density"), [(64, 0.25), (128, 0.5)])
def test_contours_of_both_backends_agree(monkeypatch, name, size, density):
    """99.5 % of the points are the same; the others are grazed by their rays."""
    mesh = MESHES[name]()
    contours = MeshContours(mesh)
    T, K = poses_of(mesh, size, 6)
    expected = contours.points(T, K[None], size, density=density)
    device_contours = by_face_tests(mesh, monkeypatch)
    found = device_contours.points(T, K[None], size, density=density)
    gaps = []
    same_side = []
    for k in range(len(T)):
        mine = found.valid[k]
        theirs = expected.valid[k]
        distance = torch.cdist(expected.model[k][theirs], found.model[k][mine])
        gap, nearest = distance.min(dim=1)
        gaps.append(gap)
        normals = found.normals[k][mine][nearest]
        same_normal = (normals - expected.normals[k][theirs]).norm(dim=1) < 1e-3
        same_outline = found.outline[k][mine][nearest] == expected.outline[k][theirs]
        same_side.append((same_normal & same_outline)[gap < 1e-4 * contours.radius])
    is_found = torch.cat(gaps) < 1e-4 * contours.radius
    assert len(is_found) > 50
    assert is_found.float().mean() >= 0.995
    assert torch.cat(same_side).float().mean() >= 0.995
    assert abs(int(found.valid.sum()) - int(expected.valid.sum())) <= 0.005 * len(is_found)


def test_contours_do_not_depend_on_the_batch(monkeypatch):
    contours = by_face_tests(example_mesh(), monkeypatch)
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
