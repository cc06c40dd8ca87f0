import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

import curvireg_torch as cr
from curvireg_torch.errors import MeshError
from curvireg_torch.mesh import normalization_transform
from curvireg_torch.mesh.edges import MeshEdges, encloses_volumes, simplified
from curvireg_torch.mesh.mesh import as_mesh, extreme_points, principal_rotation
from curvireg_torch.rendering.contours import MeshContours
from tests._support import double, eye, refused, seeded
from tests._support.tables import text_table


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (1.0, 0.9, 0.02), (1.0, 0.05, 0.05)])
def test_extreme_points_of_a_large_hull_keep_the_boxes(scale):
    mesh = trimesh.creation.icosphere(subdivisions=5)  # 10 242 vertices, all on the hull
    mesh.apply_scale(scale)
    points = extreme_points(mesh)
    assert len(points) <= 2562
    assert {tuple(p) for p in points.tolist()} <= {tuple(p) for p in mesh.vertices.tolist()}
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=seeded(0)), dim=1)
    whole, few = (
        x @ directions.double().T for x in (torch.from_numpy(np.array(mesh.vertices)), points)
    )
    width = whole.amax(dim=0) - whole.amin(dim=0)
    assert ((whole.amax(dim=0) - few.amax(dim=0)) / width).max() < 0.0015


@pytest.mark.parametrize("seed", range(4))
def test_normalization_transform_is_invariant_to_similarities(truck, seed):
    T = eye(4)
    T[:3, :3] = 7.0 * torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    T[:3, 3] = torch.tensor([3.0, -2.0, 5.0])
    meshes = truck, truck.copy().apply_transform(T.numpy())
    transforms = [normalization_transform(mesh) for mesh in meshes]
    first, second = (
        torch.tensor(mesh.copy().apply_transform(T.numpy()).vertices)
        for mesh, T in zip(meshes, transforms, strict=True)
    )
    assert_close(first, second, rtol=0, atol=1e-9)
    spread = first.square().mean(dim=0)
    assert spread[0] > spread[1] > spread[2]
    assert first.norm(dim=1).max() == pytest.approx(1.0)
    rotation = principal_rotation(truck)
    assert_close(rotation @ rotation.T, eye(3), rtol=0, atol=1e-12)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mesh_is_as_large_as_its_longest_side(axis):
    sides = np.full(3, 5e-7)
    sides[axis] = 2e-6
    assert len(as_mesh(trimesh.creation.box(sides)).faces) == 12
    with refused("only 8e-07 units across", MeshError):
        as_mesh(trimesh.creation.box(0.4 * sides))


@pytest.mark.parametrize(
    ("suffix", "up"), [("glb", "y"), ("ply", "z"), ("stl", "z"), ("off", "z"), ("obj", "z")]
)
def test_load_mesh_notes_the_up_axis(tmp_path, suffix, up):
    path = tmp_path / f"a.{suffix}"
    trimesh.creation.box((1.0, 2.0, 3.0)).export(path)
    mesh = cr.load_mesh(path)
    assert mesh.up == as_mesh(mesh).up == up
    assert_allclose(mesh.extents, [1, 2, 3], rtol=1e-6)  # not rotated
    assert cr.load_mesh(path, up="-x").up == "-x"
    with refused("up: expected one of 'x'"):
        cr.load_mesh(path, up="w")


def test_a_surface_encloses_volumes_where_each_edge_has_two_faces_of_one_orientation():
    box = trimesh.creation.box()
    corners = np.asarray(box.vertices)
    faces = np.asarray(box.faces)
    inside_out = faces[:, ::-1]

    def closed(vertices, *parts):
        surface = trimesh.Trimesh(np.vstack(vertices), np.vstack(parts), process=False)
        return encloses_volumes(surface)

    assert closed(corners, faces)
    assert closed(1e-4 * corners + 50.0, faces)
    assert closed([corners, corners + 3.0], faces, faces + 8)
    assert not closed([2.0 * corners, corners + 3.0], faces, inside_out + 8), "one inside out"
    assert not closed(corners, inside_out)
    assert not closed(corners, faces[:0])
    assert closed(corners[faces].reshape(-1, 3), np.arange(36).reshape(12, 3)), "not welded"
    assert closed(corners, faces, [[0, 0, 1]]), "one without area"
    assert not closed(corners, faces[1:])
    assert not closed(corners, faces, faces[:1])
    assert not closed(corners, inside_out[:1], faces[1:])
    assert not closed([corners, corners], faces, faces + 8)


def test_edges_of_one_vertex_are_neighbours():
    """Contour points are spread along the edges in this order, and so over the whole contour."""
    edges = MeshEdges(trimesh.creation.icosphere(subdivisions=3), np.zeros(3), max_faces=2000).edges
    assert edges.tolist() == sorted(edges.tolist())


def test_parts_smaller_than_what_is_welded_keep_their_edges():
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=float)
    mesh = trimesh.Trimesh(
        np.concatenate([corner, corner + np.array([1e7, 0, 0])]),
        [[0, 1, 2], [3, 4, 5]],
        process=False,
    )
    vertices, faces = simplified(mesh, np.zeros(3), 100)
    assert np.array_equal(vertices[faces], mesh.triangles)
    assert len(MeshEdges(mesh, np.zeros(3), 100).edges) == 6
    K = double([[100.0, 0, 31.5], [0, 100, 31.5], [0, 0, 1]])
    T = eye(4)[None]
    T[0, 2, 3] = 2e7
    points = MeshContours(mesh).points(T, K[None], 64)
    assert points.model.isfinite().all()


SIZES = """
99.0   | []
101.0  | ["give the unit (mm?)"]
900.0  | ["give the unit (mm?)"]
0.0051 | []
0.0049 | ["give the unit"]
"""


@pytest.mark.parametrize(("size", "advice"), text_table(SIZES))
def test_load_mesh_warns_of_the_size(tmp_path, recwarn, size, advice):
    trimesh.creation.box(np.full(3, size / 3**0.5)).export(tmp_path / "a.ply")
    cr.load_mesh(tmp_path / "a.ply")
    messages = [one.message for one in recwarn]
    assert [str(one).partition(" m across; if that is wrong, ")[2] for one in messages] == advice
    assert all(one.kind == "unit" for one in messages)


def test_a_part_of_a_scene_is_moved_and_mirrored_with_the_colours_of_its_corners():
    """Its faces are turned over, and the colours of their corners with them."""
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    box.visual.vertex_colors = np.where(box.vertices > 0, 255, 0).astype(np.uint8)
    place = np.diag([1.0, -1.0, 1.0, 1.0])
    place[:3, 3] = 5.0
    mesh = as_mesh(trimesh.Scene(box).apply_transform(place))
    corners = (mesh.vertices[mesh.faces] - 5.0) * [1.0, -1.0, 1.0]
    assert_allclose(mesh.bounds, [[4.0] * 3, [6.0] * 3])
    np.testing.assert_array_equal(mesh.colours.corners, np.where(corners > 0, 255, 0))
    assert mesh.surface.volume == pytest.approx(8.0)


def test_a_degenerate_face_takes_no_colours_away(tmp_path):
    points = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 0 1\n")
    (tmp_path / "a.obj").write_text(
        f"mtllib a.mtl\n{points}usemtl a\nf 1 1 2\nf 1 2 3\nusemtl b\nf 2 4 3\n"
    )
    mesh = cr.load_mesh(tmp_path / "a.obj")
    assert mesh.has_colours
    assert mesh.colours.corners[:, 0].tolist() == [[255, 0, 0], [0, 0, 255]]


def test_bytes_of_the_files_beside_a_mesh_are_bounded_together(tmp_path, monkeypatch):
    monkeypatch.setattr("curvireg_torch.formats.meshes.source.MAX_MESH_BYTES", 1000)
    names = [f"{k}.mtl" for k in range(3)]
    for name in names:
        (tmp_path / name).write_text(f"newmtl m{name}\n# {'x' * 330}\n")
    path = tmp_path / "a.obj"
    path.write_text(f"mtllib {' '.join(names[:2])}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert len(cr.load_mesh(path).faces) == 1
    path.write_text(path.read_text().replace("1.mtl", "1.mtl 2.mtl"))
    with refused("the files that it names hold more than 1,000 bytes", MeshError):
        cr.load_mesh(path)


def test_a_mesh_keeps_its_measures_and_callers_have_copies():
    mesh = as_mesh(trimesh.creation.box((1.0, 2.0, 3.0)))
    extreme_points(mesh).zero_()
    points = extreme_points(mesh)
    assert points.abs().max() == 1.5
    known = pickle.loads(pickle.dumps(mesh)).measures
    assert torch.equal(known["extreme_points"], points), "they travel with the mesh"
    mesh.measures["extreme_points"] = 2.0 * points
    assert torch.equal(extreme_points(mesh), 2.0 * points)
    assert torch.equal(extreme_points(mesh.surface), points)
    assert replace(mesh, up="y").measures == {}, "another mesh has its own"


def test_a_mesh_does_not_change_with_what_it_was_made_of():
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    box.visual.face_colors = np.repeat([[250, 0, 0, 255], [0, 0, 250, 255]], 6, axis=0)
    mesh = as_mesh(box)
    assert mesh.has_colours
    vertices = mesh.vertices.copy()
    box.vertices[:] *= 2.0
    box.apply_scale(3.0)
    box.visual.face_colors[:] = 0
    np.testing.assert_array_equal(mesh.vertices, vertices)
    assert mesh.colours.corners.max() == 250
    assert as_mesh(mesh) is mesh
    with pytest.raises(FrozenInstanceError):
        mesh.up = "y"
    for change in ({"up": "w"}, {"unit": "miles"}):
        with refused(f"{next(iter(change))}: expected one of"):
            replace(mesh, **change)
    assert not replace(mesh, colours=None).has_colours
    assert not replace(
        mesh, colours=replace(mesh.colours, corners=0 * mesh.colours.corners)
    ).has_colours


@pytest.mark.parametrize(
    ("units", "unit"), [("millimeters", "mm"), ("in", "in"), (None, None), ("miles", None)]
)
def test_as_mesh_keeps_the_unit_of_trimesh(units, unit):
    box = trimesh.creation.box()
    box.units = units
    assert as_mesh(box).unit == as_mesh(trimesh.Scene(box)).unit == unit
