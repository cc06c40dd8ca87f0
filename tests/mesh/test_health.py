"""Left-over parts far away, rounded coordinates, and colours that do not vary."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

import curvireg_torch as cr
from curvireg_torch.mesh import Mesh, mesh_centre, mesh_radius
from curvireg_torch.mesh.colours import SurfaceColours
from curvireg_torch.mesh.health import stray_faces
from curvireg_torch.mesh.mesh import as_mesh
from curvireg_torch.synthetic import example_mesh
from tests._support import answer_to, bank_around, unrefined

SIDES = (60.0, 40.0, 30.0)


def joined(*meshes):
    return trimesh.util.concatenate(list(meshes))


def triangle(size, at):
    corners = np.array([[0, 0, 0], [size, 0, 0], [0, size, 0]]) + at
    return trimesh.Trimesh(corners, [[0, 1, 2]], process=False)


def box(at=(0.0, 0.0, 0.0), sides=SIDES):
    mesh = trimesh.creation.box(sides)
    mesh.apply_translation(at)
    return mesh


def row_of_chips(axis):
    """A box, and a row of chips along an axis, 7 apart."""
    places = np.zeros((5, 3))
    places[:, axis] = 0.5 * SIDES[axis] + 7.0 * np.arange(1, 6)
    return joined(box(), *(triangle(1.0, (x, y, z)) for x, y, z in places))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(
    "at", [(300.0, 0.0, 0.0), (0.0, -120.0, 0.0), (0.0, 0.0, 1e6), (80.0, 80.0, 80.0)]
)
def test_left_over_parts_do_not_set_the_box(scale, at):
    whole = joined(triangle(1.0, at), box(), triangle(1.0, (at[0], at[1] + 3.0, at[2])))
    whole.apply_scale(scale)
    mesh = as_mesh(whole)
    assert len(mesh.faces) == 12
    assert_allclose(mesh.extents, np.array(SIDES) * scale)
    assert mesh_radius(mesh) == pytest.approx(0.5 * float(np.linalg.norm(SIDES)) * scale)
    assert mesh_centre(mesh).abs().max() < 1e-9 * scale
    (warning,) = mesh.warnings
    assert warning.kind == "stray"
    assert "of 14 faces 2 near" in warning.text
    assert as_mesh(mesh).warnings == (warning,), "told once"


def test_colours_stay_with_their_faces():
    whole = joined(triangle(1.0, (300.0, 0.0, 0.0)), box())
    colours = np.arange(39, dtype=np.uint8).reshape(13, 3) * 6
    whole.visual = trimesh.visual.ColorVisuals(whole, face_colors=colours)
    found = as_mesh(whole).colours
    np.testing.assert_array_equal(found.corners[:, 0], colours[1:])


WHOLE = {
    "0.9 % of the area": joined(box(), box((100.0, 0.0, 0.0), (4.0, 4.0, 4.0))),
    "thin mast on the top": joined(box(), box((0.0, 0.0, 60.0), (0.2, 0.2, 90.0))),
    "chip near the surface": joined(box(), triangle(1.0, (34.0, 0.0, 0.0))),
    **{f"row of chips along {axis}": row_of_chips(axis) for axis in range(3)},
    "knob above a plate": joined(box(sides=(60.0, 40.0, 1e-3)), triangle(2.0, (0.0, 0.0, 3.0))),
    "inside": joined(box(), box(sides=(200.0, 200.0, 200.0))),
    "loose triangles": joined(*(triangle(5.0, (k * k, k, 0.0)) for k in range(60))),
    "sphere": trimesh.creation.icosphere(2),
    "triangle": triangle(1.0, (0.0, 0.0, 0.0)),
    "rod": box(sides=(1000.0, 1.0, 1.0)),
}


@pytest.mark.parametrize("whole", WHOLE.values(), ids=WHOLE)
def test_parts_that_belong_to_the_object_stay(whole):
    assert not stray_faces(whole).any()
    mesh = as_mesh(whole)
    assert (len(mesh.faces), mesh.warnings) == (len(whole.faces), ())


def test_a_tiny_part_inside_the_box_stays():
    ring = trimesh.creation.annulus(90.0, 100.0, 10.0)
    inside = triangle(1.0, (0.0, 0.0, 0.0))
    far = triangle(1.0, (0.0, 0.0, 900.0))
    mesh = as_mesh(joined(ring, inside, far))
    assert len(mesh.faces) == len(ring.faces) + 1


def test_the_warning_of_a_file_names_it(tmp_path, load):
    joined(box(), triangle(1.0, (300.0, 0.0, 0.0))).export(tmp_path / "scan.ply")
    mesh, (text,) = load(tmp_path / "scan.ply", unit="mm")
    assert text.startswith(f"{tmp_path / 'scan.ply'}: of 13 faces 1 near (300.3, 0.3333, 0)")
    assert mesh.extents.tolist() == list(SIDES)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl"])
def test_coordinates_of_maps(tmp_path, load, suffix):
    """Text keeps the digits, single precision does not, and says so."""
    offset = np.array([4.4e6, 5.1e5, 4.6e6])
    sphere = trimesh.creation.icosphere(3, 40.123)
    sphere.apply_translation(offset)
    sphere.export(tmp_path / f"a.{suffix}")
    mesh, texts = load(tmp_path / f"a.{suffix}", unit="mm")
    if suffix == "obj":
        assert not texts
        assert_allclose(mesh.vertices[mesh.faces] - offset, sphere.triangles - offset, atol=1e-6)
    else:
        assert "rounded to steps of 0.5" in texts[0]
        assert [warning.kind for warning in mesh.warnings] == ["precision"]
    near = trimesh.creation.icosphere(3, 40.123)
    near.export(tmp_path / f"b.{suffix}")
    assert not load(tmp_path / f"b.{suffix}", unit="mm")[1]


def coloured(**visual):
    mesh = trimesh.creation.cylinder(30.0, 100.0, sections=96)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, **visual)
    return as_mesh(mesh)


def test_colours_that_do_not_vary_are_none():
    faces = len(trimesh.creation.cylinder(30.0, 100.0, sections=96).faces)
    for shade in (0, 100, 255):
        assert not coloured(face_colors=np.full((faces, 3), shade, np.uint8)).has_colours
    noise = np.random.default_rng(0).integers(0, 8, (faces, 3), np.uint8) + 100
    assert not coloured(face_colors=noise).has_colours
    one = np.full((faces, 3), 100, np.uint8)
    one[:3, 2] = 130  # 3 faces, 1 % of the surface
    assert coloured(face_colors=one).has_colours


@pytest.mark.parametrize("fraction", [0.0, 0.0005, 0.01, 0.5])
def test_a_texture_counts_if_a_word_of_it_differs(fraction):
    side = 400
    texture = np.full((side, side, 3), 200, np.uint8)
    width = round(side * fraction**0.5)
    texture[:width, :width, 1] = 90
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = trimesh.Trimesh(square, faces, process=False)
    colours = SurfaceColours.plain(2).with_texture([0, 1], texture, square[faces, :2])
    assert Mesh(mesh, colours=colours).has_colours == (fraction > 0.002)


def test_notes_reach_the_result():
    truck = example_mesh()
    radius = mesh_radius(truck)
    mesh = as_mesh(joined(truck, triangle(0.001 * radius, (9.0 * radius, 0.0, 0.0))))
    bank = bank_around(mesh, 60, [20], image_size=64)
    result = answer_to(0, cr.Registrar(bank, pipeline=unrefined(bank)))
    (text,) = result.to_dict()["warnings"]
    assert "apart from the rest: left out" in text
    assert result.notes == (text,)
    assert result.warnings == (), "the pose is no less reliable"
    assert text in repr(result)


def test_a_part_of_half_a_percent_is_no_leftover():
    parts = [trimesh.creation.box((1.0, 1.0, 1.0))]
    for side, place in ((0.07, 3.0), (0.02, -3.0)):
        part = trimesh.creation.box((side, side, side))
        parts.append(part.apply_translation([place, 0.0, 0.0]))
    stray = stray_faces(trimesh.util.concatenate(parts))
    assert stray.tolist() == [False] * 24 + [True] * 12
