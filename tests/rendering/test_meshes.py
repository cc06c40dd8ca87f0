"""Meshes as they are: inside out, doubled, degenerate, in parts, huge."""

import numpy as np
import pytest
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.errors import InvalidInputError, MeshError, RenderingError
from curvireg_torch.io.meshes.mesh import as_mesh
from curvireg_torch.rendering import make_renderer

from .scenes import BACKENDS, camera, interior, require


def render(mesh: object, backend: str, **options: bool) -> torch.Tensor:
    require(backend)
    T, K, size = camera(4, **options)
    return cr.render_depth(mesh, T, K, size, renderer=backend, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("backend", BACKENDS)
def test_inverted_and_mixed_faces_change_nothing(backend: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    expected = render(mesh, backend)
    assert (expected > 0).sum() > 1000
    for flipped in (slice(None), slice(0, None, 2)):
        faces = mesh.faces.copy()
        faces[flipped] = faces[flipped, ::-1]
        other = render(trimesh.Trimesh(mesh.vertices, faces, process=False), backend)
        assert torch.equal(other > 0, expected > 0)
        torch.testing.assert_close(other, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_open_mesh_shows_its_inside(backend: str) -> None:
    # A box without the side that faces the camera: its back wall is seen.
    mesh = trimesh.creation.box()
    front = np.abs(mesh.triangles_center[:, 2] + 0.5) < 1e-9
    opened = trimesh.Trimesh(mesh.vertices, mesh.faces[~front], process=False)
    T = torch.eye(4)
    T[2, 3] = 4.0
    K = torch.tensor([[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]])
    require(backend)
    depths = [float(cr.render_depth(m, T, K, (30, 40), renderer=backend)[0, 0, 15, 20]) for m in (mesh, opened)]
    assert depths == pytest.approx([3.5, 4.5], abs=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_doubled_and_non_manifold_and_degenerate_faces_change_nothing(backend: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    expected = render(mesh, backend)
    inner = mesh.copy().apply_scale(0.5)
    vertices = np.concatenate([mesh.vertices, inner.vertices, [[np.nan] * 3]])  # the last one belongs to no face
    bridge = [[0, 1, len(mesh.vertices) + 5], [0, 1, len(mesh.vertices) + 9]]  # an edge with four faces, hidden
    degenerate = [[3, 3, 3], [4, 4, 7], [0, 0, 1]]
    faces = np.concatenate([mesh.faces, mesh.faces[::3], inner.faces + len(mesh.vertices), bridge, degenerate])
    other = render(trimesh.Trimesh(vertices, faces, process=False, validate=False), backend)
    assert torch.equal(other > 0, expected > 0)
    torch.testing.assert_close(other, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_scene_parts_are_placed_by_their_transforms(backend: str) -> None:
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], [0.1, 0, 0])
    part = trimesh.creation.box((0.3, 0.5, 0.7))
    scene = trimesh.Scene()
    scene.add_geometry(part, node_name="a", transform=turn)
    scene.add_geometry(part, node_name="b", parent_node_name="a", transform=turn)  # relative to a
    whole = trimesh.util.concatenate([part.copy().apply_transform(turn), part.copy().apply_transform(turn @ turn)])
    assert torch.equal(render(scene, backend), render(whole, backend))


def test_textures_change_no_depth() -> None:
    plain = trimesh.creation.box()
    textured = plain.copy()
    textured.visual = trimesh.visual.TextureVisuals(uv=np.random.default_rng(0).random((len(plain.vertices), 2)))
    assert torch.equal(render(textured, "embree"), render(plain, "embree"))
    assert not hasattr(as_mesh(textured).visual, "uv")


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("backend", BACKENDS)
def test_camera_inside_and_object_behind(backend: str, orthographic: bool) -> None:
    require(backend)
    renderer = make_renderer(trimesh.creation.box((2.0, 2.0, 2.0)), backend)
    K = torch.tensor([[30.0, 0, 19.5], [0, 30.0, 14.5], [0, 0, 1]])
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 2, 3] = torch.tensor([0.25, -5.0, 1.0 + 2e-3 * 3**0.5])  # inside; behind; just in front
    depth = renderer.render(T, K, (30, 40), orthographic=orthographic)
    assert depth[0, 0, 15, 20] == pytest.approx(1.25, abs=1e-4)
    assert bool((depth[1] == 0).all())
    assert depth[2, 0, 15, 20] == pytest.approx(2e-3 * 3**0.5, abs=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_unseen_and_no_views(backend: str) -> None:
    require(backend)
    renderer = make_renderer(trimesh.creation.box(), backend)
    T, K, size = camera(2)
    aside = T.clone()
    aside[:, 0, 3] += 100.0
    assert bool((renderer.render(aside, K, size) == 0).all())
    assert renderer.render(T[:0], K, size).shape == (0, 1, *size)


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_camera_matrix_for_each_view(backend: str) -> None:
    require(backend)
    renderer = make_renderer(trimesh.creation.box(), backend)
    T, K, size = camera(2)
    Ks = torch.stack([K, K])
    Ks[1, :2] *= 0.5
    both = renderer.render(T, Ks, size)
    assert torch.equal(both[:1], renderer.render(T[:1], Ks[0], size))
    assert torch.equal(both[1:], renderer.render(T[1:], Ks[1], size))
    assert not torch.equal(both[:1], both[1:])


@pytest.mark.parametrize("backend", BACKENDS)
def test_tiny_far_and_shifted_objects_lose_no_digits(backend: str) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    expected = render(mesh, backend)
    require(backend)
    T, K, size = camera(4)
    for scale, shift in ((1e-4, [0.0, 0, 0]), (1e3, [2e6, -1e6, 5e5])):
        moved = mesh.copy().apply_scale(scale).apply_translation(shift)
        pose = T.clone()
        pose[:, :3, 3] = T[:, :3, 3] * scale - T[:, :3, :3] @ torch.tensor(shift, dtype=torch.float64)
        depth = make_renderer(moved, backend).render(pose, K, size)
        torch.testing.assert_close(depth / scale, expected, rtol=0, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_million_faces(backend: str) -> None:
    require(backend)
    mesh = trimesh.creation.icosphere(subdivisions=8)
    assert len(mesh.faces) > 1_000_000
    T, K, size = camera(2)
    depth = make_renderer(mesh, backend).render(T, K, size)
    coarse = make_renderer(trimesh.creation.icosphere(subdivisions=6), "embree").render(T, K, size)
    both = (depth > 0) & (coarse > 0)
    assert float((depth - coarse)[both].abs().median()) < 1e-3
    assert int(((depth > 0) != (coarse > 0)).sum()) < 0.01 * both.sum()


def test_arguments_are_checked() -> None:
    T, K, size = camera(2)
    box = trimesh.creation.box()
    bad = T.clone()
    bad[1, 0, 3] = torch.nan
    for arguments, match in (
        ((T[:, :3], K, size), "expected shape"),
        ((bad, K, size), "finite"),
        ((T, K.expand(3, 3, 3), size), "one or 2 matrices"),
        ((T, K, (0, 5)), "size"),
        ((T, -K, size), "FX, FY > 0"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            cr.render_depth(box, *arguments)
    with pytest.raises(InvalidInputError, match="'torch'"):
        cr.render_depth(box, T, K, size, renderer="opengl")
    with pytest.raises(MeshError, match="degenerate"):
        cr.render_depth(trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False), T, K, size)


def test_auto_falls_back(monkeypatch: pytest.MonkeyPatch) -> None:
    from curvireg_torch.rendering import factory, opengl

    box = trimesh.creation.box()
    assert make_renderer(box).name == "embree"
    monkeypatch.setattr(factory.importlib.util, "find_spec", lambda _: None)

    def no_driver(_: object) -> None:
        raise RenderingError("no EGL")

    monkeypatch.setattr(opengl, "PyrenderRenderer", no_driver)
    assert make_renderer(box).name == "torch"


def test_another_takes_over_from_one_that_dies(monkeypatch: pytest.MonkeyPatch) -> None:
    from curvireg_torch.rendering import opengl
    from curvireg_torch.rendering.embree import EmbreeRenderer

    def no_driver(_: object) -> None:
        raise RenderingError("no EGL")

    monkeypatch.setattr(opengl, "PyrenderRenderer", no_driver)
    renderer = make_renderer(trimesh.creation.box())
    T, K, size = camera(2)
    expected = renderer.render(T, K, size)
    with pytest.raises(InvalidInputError):  # the caller's own mistake is nobody's death
        renderer.render(T[:, :3], K, size)
    assert renderer.name == "embree"

    def dies(*_: object) -> None:
        raise MemoryError("out of memory")

    monkeypatch.setattr(EmbreeRenderer, "_rays", dies)
    with pytest.warns(UserWarning, match="'embree' failed.*out of memory.*'torch'"):
        found = renderer.render(T, K, size)
    assert renderer.name == "torch"
    even = interior(found, expected)
    torch.testing.assert_close(found[even], expected[even], rtol=0, atol=1e-4)
    renderer.render(T, K, size)  # said once: a second warning would fail this test
    with pytest.raises(RenderingError, match="embree"):  # who asked for one renderer gets no other
        cr.render_depth(trimesh.creation.box(), T, K, size, renderer="embree")
