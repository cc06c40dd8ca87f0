"""Unusual meshes and cameras: inside out, doubled, degenerate, in parts, tiny, huge, behind the
camera."""

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import trimesh
from torch.testing import assert_close

import curvireg_torch as cr
from curvireg_torch.errors import MeshError, RenderingError
from curvireg_torch.rendering import make_renderer
from curvireg_torch.rendering.contours import MeshContours
from tests._support import double, eye, refused
from tests._support.spies import spied

from .conftest import camera


def render(mesh, backend):
    return cr.render_depth(mesh, *camera(4), renderer=backend)


def assert_same_depth(found, expected, *, atol=1e-5):
    assert (expected > 0).sum() > 1000
    assert torch.equal(found > 0, expected > 0)
    assert_close(found, expected, rtol=0, atol=atol)


def test_render_ignores_face_orientation_and_doubled_and_degenerate_faces(backend):
    mesh = trimesh.creation.icosphere(subdivisions=2)
    for flipped in (slice(None), slice(0, None, 2)):
        faces = mesh.faces.copy()
        faces[flipped] = faces[flipped, ::-1]
        assert_same_depth(
            render(trimesh.Trimesh(mesh.vertices, faces, process=False), backend),
            render(mesh, backend),
        )
    inner = mesh.copy().apply_scale(0.5)
    # no face uses the last one
    vertices = np.concatenate([mesh.vertices, inner.vertices, [[np.nan] * 3]])
    # a hidden edge with four faces
    bridge = [[0, 1, len(mesh.vertices) + 5], [0, 1, len(mesh.vertices) + 9]]
    degenerate = [[3, 3, 3], [4, 4, 7], [0, 0, 1]]
    faces = np.concatenate(
        [mesh.faces, mesh.faces[::3], inner.faces + len(mesh.vertices), bridge, degenerate]
    )
    damaged = trimesh.Trimesh(vertices, faces, process=False, validate=False)
    assert_same_depth(render(damaged, backend), render(mesh, backend))


def test_render_with_the_camera_inside_and_the_object_behind(backend, orthographic):
    renderer = make_renderer(trimesh.creation.box((2.0, 2.0, 2.0)), backend)
    wide = cr.camera_matrix(30.0, 30.0, 19.5, 14.5)
    near = 2e-3 * 3**0.5
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 2, 3] = torch.tensor([0.25, -5.0, 1.0 + near])  # inside; behind; just in front
    depth = renderer.render(T, wide, (30, 40), orthographic=orthographic)
    assert depth[0, 0, 15, 20] == pytest.approx(1.25, abs=1e-4)
    assert (depth[1] == 0).all()
    assert depth[2, 0, 15, 20] == pytest.approx(near, abs=1e-4)


def test_render_batches(backend):
    """No views, an object outside the image, and a camera matrix per view."""
    renderer = make_renderer(trimesh.creation.box(), backend)
    T, one, size = camera(2)
    outside = T.clone()
    outside[:, 0, 3] += 100.0
    assert (renderer.render(outside, one, size) == 0).all()
    assert renderer.render(T[:0], one, size).shape == (0, 1, *size)
    both = torch.stack([one, one])
    both[1, :2] *= 0.5
    depth = renderer.render(T, both, size)
    assert torch.equal(depth[:1], renderer.render(T[:1], both[0], size))
    assert torch.equal(depth[1:], renderer.render(T[1:], both[1], size))
    assert not torch.equal(depth[:1], depth[1:])


@pytest.mark.parametrize(("scale", "shift"), [(1e-4, [0.0, 0, 0]), (1e3, [2e6, -1e6, 5e5])])
def test_render_is_precise_for_tiny_and_distant_objects(backend, scale, shift):
    mesh = trimesh.creation.icosphere(subdivisions=2)
    T, one, size = camera(4)
    moved = mesh.copy().apply_scale(scale).apply_translation(shift)
    pose = T.clone()
    pose[:, :3, 3] = T[:, :3, 3] * scale - T[:, :3, :3] @ double(shift)
    depth = make_renderer(moved, backend).render(pose, one, size)
    assert_close(depth / scale, render(mesh, backend), rtol=0, atol=2e-5)


def test_render_depth_refuses_bad_arguments_and_replaces_no_renderer_that_fails():
    T, one, size = camera(2)
    box = trimesh.creation.box()
    not_finite = T.clone()
    not_finite[1, 0, 3] = torch.nan
    calls = [
        ((not_finite, one, size), "finite"),
        ((T, one.expand(3, 3, 3), size), "one or 2 matrices"),
    ]
    calls += [((T, one, wrong), "size: expected") for wrong in ((0, 5), (4.0, 4.0), (4, 4, 3), 64)]
    calls.append((([[1.0]], one, size), r"T_cam_from_model: expected a torch\.Tensor, got list"))
    for arguments, message in calls:
        with refused(message):
            cr.render_depth(box, *arguments)
    with refused("'embree'"):
        cr.render_depth(box, T, one, size, renderer="opengl")
    with refused("degenerate", MeshError):
        cr.render_depth(trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False), T, one, size)
    fail = Mock(side_effect=MemoryError("out of memory"))
    with refused("out of memory", RenderingError):
        cr.render_depth(
            trimesh.creation.box(), *camera(2), renderer=SimpleNamespace(name="mine", render=fail)
        )


def test_contours_of_a_small_crop_are_those_of_a_coarser_mesh(monkeypatch):
    # 20 480 faces
    contours = MeshContours(trimesh.creation.icosphere(subdivisions=5))
    used = spied(monkeypatch, contours, "_level")
    T = eye(4)[None]
    T[0, 2, 3] = 4.0
    for size in (100, 128, 129, 256, 400):
        middle = (size - 1) / 2
        points = contours.points(T, cr.camera_matrix(size, size, middle, middle)[None], size)
        assert (points.model.norm(dim=-1)[points.valid] - 1.0).abs().max() < 0.005
    faces = [len(contours._edges[limit].faces) for (limit,) in used]
    assert faces == [2500, 2500, 8000, 8000, 8000]
