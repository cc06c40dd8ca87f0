"""Every backend gives the same depth, and that depth is right."""

import itertools

import cv2
import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry import project_points
from curvireg_torch.io.meshes import mesh_centre, mesh_radius
from curvireg_torch.rendering import make_renderer
from curvireg_torch.rendering.zbuffer import TorchRenderer
from curvireg_torch.synthetic import example_mesh

from .scenes import BACKENDS, camera, interior, require, smooth

PAIRS = list(itertools.combinations(BACKENDS, 2))
MESHES = {
    "parts": example_mesh,
    "fine": lambda: trimesh.creation.icosphere(subdivisions=4, radius=40.0).apply_translation([300.0, -20.0, 5.0]),
    "knot": lambda: trimesh.creation.torus(1.0, 0.3, major_sections=60, minor_sections=30),
}


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_backends_agree(pair: tuple[str, str], name: str, orthographic: bool) -> None:
    require(*pair)
    mesh = MESHES[name]()
    radius = mesh_radius(mesh)
    T, K, size = camera(6, radius=radius, centre=mesh_centre(mesh), orthographic=orthographic)
    a, b = (make_renderer(mesh, backend).render(T, K, size, orthographic=orthographic) for backend in pair)
    inside = interior(a, b)
    assert int(((a > 0) != (b > 0))[inside].sum()) == 0
    even = inside & (a > 0) & smooth(a, bend=0.01 * radius)
    assert even.sum() > 5000
    assert float((a - b)[even].abs().max()) <= 1e-5 * radius
    assert int(((a > 0) != (b > 0)).sum()) <= 10  # on rims, in six views: rounding


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("orthographic", [False, True])
def test_sphere_against_its_equation(backend: str, orthographic: bool) -> None:
    require(backend)
    mesh = trimesh.creation.icosphere(subdivisions=6)  # flat by at most 1.5e-4 between vertices
    T, K, size = camera(2, orthographic=orthographic)
    depth = make_renderer(mesh, backend).render(T, K, size, orthographic=orthographic)[:, 0].double()
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size), indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1) @ torch.linalg.inv(K).T
    if orthographic:  # x^2 + y^2 + (z - 4)^2 = 1
        inside = 1.0 - rays[..., 0] ** 2 - rays[..., 1] ** 2
        expected = 4.0 - inside.clamp(min=0).sqrt()
    else:  # |z ray - (0, 0, 4)|^2 = 1
        a = (rays**2).sum(-1)
        inside = 16.0 - 15.0 * a
        expected = (4.0 - inside.clamp(min=0).sqrt()) / a
    facing = inside > 0.05
    assert float((depth - expected).abs()[:, facing].max()) < 5e-4
    assert not bool((depth > 0)[:, inside < 0].any())


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixel_centres_are_those_of_opencv(backend: str) -> None:
    # A plane's depth is known at every subpixel: the depth of a pixel tells where its ray was, to 1e-4 px.
    require(backend)
    plane = trimesh.Trimesh([[-3.0, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]], [[0, 1, 2], [0, 2, 3]])
    K = torch.tensor([[300.0, 0, 70.3], [0, 290.0, 51.8], [0, 0, 1]], dtype=torch.float64)
    found = []
    for axis in (0, 1):  # the plane's depth grows along x, then along y
        R = np.asarray(cv2.Rodrigues(np.array([[0.0, -0.9, 0.0], [0.9, 0.0, 0.0]][axis]))[0])
        T = torch.eye(4, dtype=torch.float64)[None].clone()
        T[0, :3, :3], T[0, 2, 3] = torch.from_numpy(R), 4.0
        depth = make_renderer(plane, backend).render(T, K, (108, 154))[0, 0].double().numpy()
        normal = R[:, 2]
        rows, columns = np.nonzero(depth)
        z = depth[rows, columns]
        other = ((columns - 70.3) / 300.0, (rows - 51.8) / 290.0)[1 - axis]
        # normal . (z x, z y, z - 4) = 0 solved for the coordinate that the depth depends on
        ray = (normal[2] * (4.0 - z) / z - normal[1 - axis] * other) / normal[axis]
        found.append(ray * (300.0, 290.0)[axis] + (70.3, 51.8)[axis] - (columns, rows)[axis])
        points = np.stack([(columns - 70.3) / 300.0 * z, (rows - 51.8) / 290.0 * z, z], 1)
        pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K.numpy(), None)[0][:, 0]
        np.testing.assert_allclose(pixels, np.stack([columns, rows], 1), atol=1e-9)
    assert max(np.abs(f).max() for f in found) < 1e-4 * 4  # worst of 16000 pixels, depth in float32
    assert all(np.abs(np.median(f)) < 1e-4 for f in found)


def test_project_points_is_opencv() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(200, 3, generator=generator, dtype=torch.float64)
    T, K, _ = camera(3)
    for pose, ours in zip(T, project_points(points, T, K), strict=True):
        rotation = cv2.Rodrigues(pose[:3, :3].numpy())[0]
        theirs = cv2.projectPoints(points.numpy(), rotation, pose[:3, 3].numpy(), K.numpy(), None)[0][:, 0]
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("backend", BACKENDS)
def test_silhouette_lies_where_project_points_says(backend: str, orthographic: bool) -> None:
    # A triangle covers exactly the pixel centres inside its projection.
    require(backend)
    triangle = trimesh.Trimesh([[-0.7, -0.5, 0.1], [0.8, -0.3, -0.2], [0.1, 0.9, 0.3]], [[0, 1, 2]])
    T, K, size = camera(5, orthographic=orthographic)
    mask = make_renderer(triangle, backend).render(T, K, size, orthographic=orthographic)[:, 0] > 0
    corners = project_points(torch.from_numpy(triangle.vertices.copy()), T, K, orthographic=orthographic)
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size), indexing="ij")
    edges = []
    for i in range(3):
        a, b = corners[:, i], corners[:, (i + 1) % 3]
        d = (b - a)[:, None, None]
        away = (u - a[:, 0, None, None]) * d[..., 1] - (v - a[:, 1, None, None]) * d[..., 0]
        edges.append(away / d.norm(dim=-1))  # px from the edge
    edges = torch.stack(edges)
    inside, outside = edges.amin(0).maximum(-edges.amax(0)), -edges.amin(0).maximum(-edges.amax(0))
    assert bool(mask[inside > 0.005].all())
    assert not bool(mask[outside > 0.005].any())
    assert int(mask.sum()) > 1000


@pytest.mark.parametrize("orthographic", [False, True])
def test_torch_renderer_gives_the_same_in_any_portions(orthographic: bool) -> None:
    # Devices other than a CPU take many views and pairs at once; here, the other way, portions that end anywhere.
    mesh = MESHES["knot"]()
    T, K, size = camera(7, radius=mesh_radius(mesh), centre=mesh_centre(mesh), orthographic=orthographic)
    renderer = TorchRenderer(mesh)
    expected = renderer.render(T, K, size, orthographic=orthographic)
    for views, triangles, pairs in ((3, 10**6, 10**7), (7, 501, 10**7), (2, 10**6, 4099)):
        renderer._views, renderer._triangles, renderer._pairs = views, triangles, pairs
        found = renderer.render(T, K, size, orthographic=orthographic)
        assert int(((found > 0) != (expected > 0)).sum()) == 0
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
