"""Procedural shapes and surfaces."""

import numpy as np
import pytest
import trimesh

from curvireg_torch.mesh import load_mesh
from curvireg_torch.rendering.embree import RayScene
from curvireg_torch.training.scenes import FAMILIES, random_shape, shape_from_mesh
from curvireg_torch.training.scenes.surfaces import bar, box, lathe, superquadric, torus


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_random_shape_of_every_family_has_radius_one(family):
    for seed in range(5):
        shape = random_shape(np.random.default_rng(seed), family)
        assert np.isfinite(shape.vertices).all()
        assert np.linalg.norm(shape.vertices, axis=1).max() == pytest.approx(1.0)
        assert 0 <= shape.faces.min() <= shape.faces.max() < len(shape.vertices)
        assert len(shape.materials) == len(shape.faces)
        assert shape.mesh().area > 0.05


def test_random_shape_depends_on_the_seed():
    one, same, other = (random_shape(np.random.default_rng(s)) for s in (3, 3, 4))
    assert np.array_equal(one.vertices, same.vertices)
    assert one.vertices.shape != other.vertices.shape or not np.array_equal(one.vertices, other.vertices)


def volume(surface):
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return abs(float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6))


def test_surfaces_have_the_volumes_of_closed_forms():
    assert volume(box((1, 2, 3))) == pytest.approx(6.0)
    assert volume(box((2, 2, 3), top=0.5)) == pytest.approx(3 / 3 * (4 + 1 + 2))  # frustum
    assert volume(lathe([0.5, 0.5], [0, 2])) == pytest.approx(np.pi * 0.25 * 2, rel=0.01)
    assert volume(superquadric((1, 1, 1), (1, 1))) == pytest.approx(4 / 3 * np.pi, rel=0.03)
    assert volume(torus(1.0, 0.2)) == pytest.approx(2 * np.pi**2 * 0.04, rel=0.08)  # ten-sided section
    assert volume(bar((0, 0, 0), (0, 3, 4), np.sqrt(0.5), sides=4)) == pytest.approx(5.0)


def open_bed(seed):
    """Whether the rear third of a car, seen from above, is lower inside than at the sides and at the end."""
    shape = random_shape(np.random.default_rng(seed), "car")
    (x0, y0, _), (x1, y1, _) = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    starts = np.stack([*np.meshgrid(np.linspace(x0, x1, 61), np.linspace(y0, y1, 121)), np.full((121, 61), 2.0)], -1)
    down = np.tile((0, 0, -1.0), (starts.size // 3, 1))
    height = 2.0 - RayScene(shape.vertices, shape.faces).distance(starts.reshape(-1, 3), down).reshape(121, 61)[85:]
    inside = np.median(height[5:25, 20:41])
    rims = [height[5:25, :20].max(axis=1), height[5:25, 41:].max(axis=1), height[-8:, 20:41].max(axis=0)]
    return all(np.median(rim) > inside + 0.03 for rim in rims)


def test_some_cars_are_pickups():
    assert 3 <= sum(open_bed(seed) for seed in range(40)) <= 16


def test_shape_from_mesh_connects_coincident_corners(tmp_path):
    """An STL file lists the corners of every triangle separately. One material per connected part; radius 1."""
    parts = [trimesh.creation.box(), trimesh.creation.icosphere(subdivisions=1), trimesh.creation.box((0.5, 2, 3))]
    for i, part in enumerate(parts):
        part.apply_translation((5 * i, 0, 0))
    trimesh.util.concatenate(parts).export(tmp_path / "parts.stl")
    mesh = load_mesh(tmp_path / "parts.stl")
    shape = shape_from_mesh(mesh)
    assert len(shape.vertices) == len(mesh.vertices) == 3 * len(mesh.faces)
    assert np.linalg.norm(shape.vertices, axis=1).max() == pytest.approx(1.0)
    of_part = np.repeat([0, 1, 2], [len(part.faces) for part in parts])
    assert len(set(zip(of_part.tolist(), shape.materials.tolist(), strict=True))) == len(set(shape.materials)) == 3
