import trimesh

from curvireg_torch.mesh.mesh import mirrored
from curvireg_torch.mesh.reflections import reflection_plane
from tests.registration.test_mirror import chiral_mesh


def test_symmetric_shapes_are_their_own_mirror_images():
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    half = chiral_mesh()
    both = trimesh.util.concatenate([half, mirrored(half).apply_translation((-3.0, 0.0, 0.0))])
    for mesh in (trimesh.creation.box((1, 2, 3)), trimesh.creation.cone(1.0, 2.0), both):
        assert reflection_plane(mesh) is None
        assert reflection_plane(mesh.copy().apply_transform(turn)) is None


def test_plane_is_that_to_which_a_mesh_is_most_nearly_symmetric():
    mast = trimesh.creation.box((0.2, 0.2, 1.2)).apply_translation((0.4, 0.35, 0.6))
    hull = trimesh.creation.box((2.0, 0.8, 0.5))
    bow = trimesh.creation.box((0.3, 0.8, 1.0)).apply_translation((0.9, 0.0, 0.4))
    plane = reflection_plane(trimesh.util.concatenate([hull, bow, mast]))
    assert abs(float(plane[1])) > 0.95, "but for its mast, the ship is symmetric from side to side"


def test_a_knob_at_one_corner_is_no_symmetry():
    """Most points of the surface have a mirror image: the few that have none count."""
    knob = trimesh.creation.box((0.2, 0.2, 0.2))
    knob.apply_translation([0.55, 0.7, 0.9])
    whole = trimesh.util.concatenate([trimesh.creation.box((1.0, 1.3, 1.7)), knob])
    assert reflection_plane(whole) is not None
