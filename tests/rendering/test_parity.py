"""Every backend gives the same depth, and that depth is right."""

import itertools
from functools import cache

import cv2
import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry import project_points
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.rendering import make_renderer
from curvireg_torch.synthetic import example_mesh

from .conftest import BACKENDS, camera, interior, pixel_grid, require, smooth


def inside_out(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def half(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[: len(mesh.faces) // 2], process=False)


def crossed_prism():
    """A closed surface over a polygon that crosses itself: half of it is inside out."""
    polygon = [[-1.0, -0.8], [1.0, 0.7], [1.0, -0.6], [-1.0, 0.9]]
    vertices = [[x, y, z] for z in (-0.5, 0.5) for x, y in polygon]
    sides = [[i, (i + 1) % 4, (i + 1) % 4 + 4, i, (i + 1) % 4 + 4, i + 4] for i in range(4)]
    faces = [[2, 1, 0], [3, 2, 0], [4, 5, 6], [4, 6, 7], *np.reshape(sides, (-1, 3)).tolist()]
    return trimesh.Trimesh(vertices, faces, process=False)


MESHES = {
    "parts": example_mesh,
    "fine": lambda: trimesh.creation.icosphere(subdivisions=4, radius=40.0).apply_translation(
        [300.0, -20.0, 5.0]
    ),
    "knot": lambda: trimesh.creation.torus(1.0, 0.3, major_sections=60, minor_sections=30),
    "open": lambda: half(trimesh.creation.icosphere(subdivisions=4)),
    "inside out": lambda: inside_out(trimesh.creation.icosphere(subdivisions=4)),
    "partly inside out": lambda: trimesh.util.concatenate(
        trimesh.creation.torus(1.0, 0.3),
        inside_out(trimesh.creation.icosphere(subdivisions=2, radius=0.6)),
    ),
    "inside out in a tube": lambda: trimesh.util.concatenate(
        trimesh.creation.annulus(0.35, 0.5, 2.0), inside_out(trimesh.creation.cylinder(0.2, 1.5))
    ),
    "crossed": crossed_prism,
}


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("pair", list(itertools.combinations(BACKENDS, 2)), ids="-".join)
def test_backends_agree(pair, name, orthographic):
    require(*pair, orthographic=orthographic)
    mesh = MESHES[name]()
    radius = mesh_radius(mesh)
    T, K, size = camera(6, radius=radius, centre=mesh_centre(mesh), orthographic=orthographic)
    a, b = (
        make_renderer(mesh, backend, many_views=True).render(T, K, size, orthographic=orthographic)
        for backend in pair
    )
    inside = interior(a, b)
    assert int(((a > 0) != (b > 0))[inside].sum()) == 0
    even = inside & (a > 0) & smooth(a, bend=0.01 * radius)
    assert even.sum() > 5000
    assert (a - b)[even].abs().max() <= 1e-5 * radius
    assert ((a > 0) != (b > 0)).sum() <= 10  # rounding at contours, in six views


@pytest.mark.parametrize("name", MESHES)
def test_back_faces_of_closed_surfaces_are_not_drawn(name):
    assert make_renderer(MESHES[name]()).draws_back_faces, "both sides of a face are visible"
    assert make_renderer(MESHES[name](), many_views=True).draws_back_faces == (
        name not in ("parts", "fine", "knot")
    )


@cache
def ball():
    """Flat by at most 1.5e-4 between its vertices."""
    return trimesh.creation.icosphere(subdivisions=6)


def test_depth_of_a_sphere(backend, orthographic):
    T, K, size = camera(2, orthographic=orthographic)
    depth = (
        make_renderer(ball(), backend).render(T, K, size, orthographic=orthographic)[:, 0].double()
    )
    rays = pixel_grid(size) @ torch.linalg.inv(K).T
    if orthographic:  # x^2 + y^2 + (z - 4)^2 = 1
        inside = 1.0 - rays[..., 0] ** 2 - rays[..., 1] ** 2
        expected = 4.0 - inside.clamp(min=0).sqrt()
    else:  # |z ray - (0, 0, 4)|^2 = 1
        a = (rays**2).sum(-1)
        inside = 16.0 - 15.0 * a
        expected = (4.0 - inside.clamp(min=0).sqrt()) / a
    facing = inside > 0.05
    assert (depth - expected).abs()[:, facing].max() < 5e-4
    assert not (depth > 0)[:, inside < 0].any()


def test_silhouette_agrees_with_project_points(backend, orthographic):
    """A triangle covers exactly the pixel centres inside its projection."""
    triangle = trimesh.Trimesh([[-0.7, -0.5, 0.1], [0.8, -0.3, -0.2], [0.1, 0.9, 0.3]], [[0, 1, 2]])
    T, K, size = camera(5, orthographic=orthographic)
    mask = make_renderer(triangle, backend).render(T, K, size, orthographic=orthographic)[:, 0] > 0
    corners = project_points(
        torch.from_numpy(triangle.vertices.copy()), T, K, orthographic=orthographic
    )
    pixels = [(x, y) for y in range(size[0]) for x in range(size[1])]
    for seen, outline in zip(mask, corners.float().numpy(), strict=True):
        inside = torch.tensor([cv2.pointPolygonTest(outline, pixel, True) for pixel in pixels])
        assert seen.flatten()[inside > 0.005].all()  # px
        assert not seen.flatten()[inside < -0.005].any()
    assert mask.sum() > 1000
