from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from curvireg_torch.geometry import camera_matrix, rotation_from_viewpoint, transform
from curvireg_torch.mesh import as_mesh, load_mesh
from curvireg_torch.rendering import make_renderer, render_colour, shade
from tests._support import double, refused

COLOURS = [
    (230, 20, 20),
    (20, 220, 30),
    (30, 40, 240),
    (240, 230, 10),
    (10, 230, 230),
    (220, 20, 230),
]
SIZE = (72, 96)
K = camera_matrix(150.0, 150.0, 47.5, 35.5)


def camera(azimuth, elevation, theta=0.0, distance=5.0):
    R = rotation_from_viewpoint(azimuth, elevation, theta)
    return transform(R, double([0.0, 0.0, distance]))[None]


def textured_box():
    """A box whose six sides show six stripes of one texture; the left and the lower half of each
    are darker."""
    picture = np.zeros((16, 6 * 32, 3), np.uint8)
    for i, colour in enumerate(COLOURS):
        picture[:, 32 * i : 32 * (i + 1)] = colour
        picture[:, 32 * i : 32 * i + 16] //= 2
    picture[8:] //= 2
    box = trimesh.creation.box()
    box.unmerge_vertices()
    axis = np.abs(box.face_normals).argmax(axis=1).repeat(3)
    index = np.arange(len(axis))
    side = 2 * axis + (box.vertices[index, axis] > 0)
    a, b = (box.vertices[index, (axis + k) % 3] for k in (1, 2))
    material = trimesh.visual.material.SimpleMaterial(
        image=Image.fromarray(picture), diffuse=[255] * 4
    )
    uv = np.stack([(side + 0.5 + a) / 6, 0.5 + 0.8 * b], axis=1)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(box.vertices, box.faces, visual=visual, process=False)


def expected_albedo(points):
    """Colour of points on the box, from their side and halves."""
    side = np.abs(points).argmax(axis=1)
    index = np.arange(len(points))
    colour = np.array(COLOURS)[2 * side + (points[index, side] > 0)]
    for k in (1, 2):
        colour = np.where(points[index, (side + k) % 3, None] < 0, colour // 2, colour)
    return colour / 255


@pytest.mark.parametrize("view", [(20.0, 30.0, 0.0), (140.0, -40.0, 25.0), (260.0, 10.0, -70.0)])
def test_render_colour_shows_the_texture_of_every_side(view, orthographic):
    mesh = textured_box()
    T = camera(*view)
    intrinsics = K.clone()
    if orthographic:
        intrinsics[:2, :2] /= 5.0
    picture = (
        render_colour(mesh, T, intrinsics, SIZE, orthographic=orthographic)[0]
        .permute(1, 2, 0)
        .double()
        .numpy()
    )
    depth = make_renderer(mesh).render(T, intrinsics, SIZE, orthographic=orthographic)
    grey = shade(depth, intrinsics, orthographic=orthographic)[0, 0].double().numpy()
    z = depth[0, 0].double().numpy()
    v, u = np.nonzero(z)
    rays = np.stack([u, v, np.ones_like(u)], 1) @ np.linalg.inv(intrinsics.numpy()).T
    points = np.c_[rays[:, :2], z[v, u]] if orthographic else rays * z[v, u, None]
    points = (points - T[0, :3, 3].numpy()) @ T[0, :3, :3].numpy()
    order = np.sort(np.abs(points), axis=1)
    # away from edges and from the lines between the halves
    clear = (order[:, 1] < 0.38) & (order[:, 0] > 0.12)
    sides = np.unique(np.abs(points).argmax(axis=1)[clear])
    assert clear.sum() > 200
    assert len(sides) >= 2
    expected = expected_albedo(points) * grey[v, u, None]
    correct = np.abs(picture[v, u] - expected).max(axis=1) < 0.02
    assert correct[clear].mean() > 0.97  # the rest are mixed at contours
    for side in sides:
        assert correct[clear & (np.abs(points).argmax(axis=1) == side)].mean() > 0.8
    assert picture[0, 0].tolist() == [1.0, 1.0, 1.0]


def test_render_colour_is_grey_without_colours_or_faces():
    mesh = as_mesh(textured_box())
    T = camera(20.0, 30.0)
    bare = replace(mesh, colours=None)
    assert mesh.has_colours
    assert not bare.has_colours
    grey = render_colour(bare, T, K, SIZE)
    assert (grey[:, 0] == grey[:, 1]).all()
    assert (grey - render_colour(mesh, T, K, SIZE)).abs().mean() > 0.05
    assert render_colour(mesh, T[:0], K, SIZE).shape == (0, 3, *SIZE)
    with refused("T_cam_from_model: expected shape"):
        render_colour(mesh, T[0, :3], K, SIZE)
    single = render_colour(bare, T, K, SIZE, supersampling=1)
    assert (single == shade(make_renderer(bare).render(T, K, SIZE), K)).all()


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_a_print_is_read_as_it_was_exported(tmp_path, suffix):
    box = textured_box()
    box.export(tmp_path / f"box.{suffix}")
    meshes = box, load_mesh(tmp_path / f"box.{suffix}")
    expected, found = (render_colour(mesh, camera(20.0, 30.0), K, SIZE) for mesh in meshes)
    torch.testing.assert_close(found, expected, rtol=0.0, atol=0.01)


def test_colours_of_vertices_are_interpolated():
    box = trimesh.creation.box()
    by_vertex = np.c_[
        np.where(box.vertices[:, 2:] > 0, [[255, 0, 0]], [[0, 255, 0]]), np.full(8, 255)
    ]
    mesh = trimesh.Trimesh(
        box.vertices, box.faces, vertex_colors=by_vertex.astype(np.uint8), process=False
    )
    picture = render_colour(mesh, camera(0.0, 0.0), K, SIZE)[0]
    assert picture[0, 24, 48] > 2 * picture[1, 24, 48]  # red above
    assert picture[1, 47, 48] > 2 * picture[0, 47, 48]  # green below
    assert picture[:2, 36, 48].tolist() == pytest.approx([0.45, 0.45], abs=0.05)
