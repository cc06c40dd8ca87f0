import trimesh

from curvireg_torch.mesh.reflections import is_its_own_mirror_image
from tests.registration.test_mirror import chiral_mesh, mirrored


def test_symmetric_shapes_are_their_own_mirror_images():
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    half = chiral_mesh()
    both = trimesh.util.concatenate([half, mirrored(half).apply_translation((-3.0, 0.0, 0.0))])
    for mesh in (trimesh.creation.box((1, 2, 3)), trimesh.creation.cone(1.0, 2.0), both):
        assert is_its_own_mirror_image(mesh)
        assert is_its_own_mirror_image(mesh.copy().apply_transform(turn))


def test_a_knob_at_one_corner_is_no_symmetry():
    """Most points of the surface have a mirror image: the few that have none count."""
    knob = trimesh.creation.box((0.2, 0.2, 0.2))
    knob.apply_translation([0.55, 0.7, 0.9])
    whole = trimesh.util.concatenate([trimesh.creation.box((1.0, 1.3, 1.7)), knob])
    assert not is_its_own_mirror_image(whole)
