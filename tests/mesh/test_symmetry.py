import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.mesh import mesh_symmetries
from curvireg_torch.mesh.symmetry import _axes, feature_fractions
from curvireg_torch.synthetic import example_mesh
from tests._support import slow_after

ROTATED = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.5, 0.9]))
BOTTLE = trimesh.creation.revolve(
    [[0, 0], [0.04, 0], [0.04, 0.15], [0.015, 0.2], [0.015, 0.25], [0, 0.25]]
)


def moved(mesh):
    mesh = mesh.copy()
    mesh.apply_transform(ROTATED)
    mesh.apply_translation([3.0, -1.0, 0.5])
    return mesh


SHAPES = [
    (trimesh.creation.box((1, 2, 3)), 4),
    (trimesh.creation.box((1, 1, 3)), 8),
    (trimesh.creation.box((1, 1, 1)), 24),
    (trimesh.creation.cylinder(1.0, 3.0, sections=3), 6),
    (moved(BOTTLE), 36),
    (example_mesh(), 1),
    (moved(trimesh.creation.box((1, 2, 3))), 4),
    (trimesh.creation.cylinder(1.0, 3.0, sections=5), 10),
    (trimesh.creation.cylinder(1.0, 3.0, sections=64), 72),
    (BOTTLE, 36),
]


@pytest.mark.parametrize(("mesh", "count"), slow_after(6, SHAPES))
def test_symmetries_map_the_shape_to_itself(mesh, count):
    symmetries = mesh_symmetries(mesh)
    assert symmetries.shape == (count, 4, 4)
    assert torch.equal(symmetries[0, :3, :3], torch.eye(3, dtype=torch.float64))
    vertices = torch.from_numpy(mesh.vertices.copy())
    size = float(np.linalg.norm(mesh.extents))
    for S in symmetries:
        turned = vertices @ S[:3, :3].T + S[:3, 3]
        _, distance, _ = trimesh.proximity.closest_point_naive(mesh, turned.numpy()[:100])
        assert distance.max() < 0.03 * size


def test_a_handle_breaks_the_symmetry():
    handle = trimesh.creation.torus(0.03, 0.006)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    handle.apply_translation([0.04, 0.0, 0.08])
    assert len(mesh_symmetries(trimesh.util.concatenate([BOTTLE, handle]))) == 1


def test_a_plain_shape_has_no_feature_wherever_it_stands():
    """Quarter turns about its own axis, far from the origin."""
    post = trimesh.creation.box((1.0, 1.0, 3.0))
    post.apply_translation([5.0, 1.0, 0.0])
    symmetries = mesh_symmetries(post)
    assert len(symmetries) == 8
    assert feature_fractions(post, symmetries).max() < 1e-3


@pytest.mark.parametrize(("extents", "count"), [((1, 1, 1), 3), ((1, 1, 3), 4), ((1, 2, 3), 6)])
def test_principal_axes_that_rounding_decides_are_not_tried(extents, count):
    """Beside the three axes of the file, those whose moments differ from the others."""
    box = trimesh.creation.box(extents)
    box.apply_transform(ROTATED)
    cloud = trimesh.sample.sample_surface(box, 40_000, seed=0)[0]
    assert len(_axes(np.asarray(cloud))) == count
