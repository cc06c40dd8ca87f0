"""Creases, smooth edges and the simplification of a mesh."""

import fast_simplification
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from curvireg_torch.mesh.edges import MeshEdges, occluding_edges, simplified
from curvireg_torch.mesh.sampling import surface_points
from curvireg_torch.synthetic import example_mesh
from tests._support.tables import text_table


def edges_of(vertices, faces):
    mesh = trimesh.Trimesh(np.array(vertices, float), np.array(faces), process=False)
    return MeshEdges(mesh, np.zeros(3), max_faces=10_000)


def at(edges, a, b):
    """The number of the edge between two places."""
    places = [tuple(place) for place in edges.vertices.round(6).tolist()]
    wanted = {places.index(a), places.index(b)}
    (found,) = [k for k, edge in enumerate(edges.edges.tolist()) if set(edge) == wanted]
    return found


def fan(angles):
    """Pages of a book, open by these angles in degrees, around the z axis."""
    outer = [(np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.5) for angle in angles]
    faces = [[0, 1, 2 + k] if k % 2 else [1, 0, 2 + k] for k in range(len(angles))]
    return edges_of([(0, 0, 0), (0, 0, 1), *outer], faces)


SPINE = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def kind_of_spine(edges):
    """Whether it is a crease, and whether it is smooth."""
    spine = at(edges, *SPINE)
    return edges.is_crease[spine], edges.is_smooth[spine]


EDGES = """
[0, 180]              | false | true
[0, 170]              | false | true  | bent by 10 degrees
[0, 150]              | true  | true
[0, 120]              | true  | false
[0, 1]                | true  | false
[0, 180, 90]          | true  | false | three pages, two of them in one plane
[0, 180, 179, 181]    | true  | false
[0, 180, 90, 270, 45] | true  | false | more than are looked at
[0]                   | false | false | a boundary
"""


@pytest.mark.parametrize("row", text_table(EDGES))
def test_what_an_edge_is(row):
    angles, is_crease, is_smooth, *_ = row
    assert kind_of_spine(fan(angles)) == (is_crease, is_smooth)


def test_the_contour_of_a_book_is_its_spine_where_all_pages_lie_on_one_side():
    edges = fan([10.0, 30.0, 50.0, 80.0])
    azimuths = np.arange(0, 360, 5) + 2.5
    x, y = np.cos(np.radians(azimuths)), np.sin(np.radians(azimuths))
    eyes = 9.0 * np.stack([x, y, np.full_like(x, 0.1)], axis=1)
    planes = torch.from_numpy(edges.side_planes())
    on_contour, _ = occluding_edges(planes, torch.from_numpy(eyes))
    # all pages lie to the left or right of the line from the camera through the spine
    expected = [80 < azimuth < 190 or not 10 < azimuth < 260 for azimuth in azimuths]
    assert on_contour[:, at(edges, *SPINE)].tolist() == expected


def test_simplification_keeps_the_number_of_faces_that_is_asked_for():
    sphere = trimesh.creation.icosphere(subdivisions=5)
    for most in (1000, 5000):
        vertices, faces = simplified(sphere, np.zeros(3), most)
        assert 0.9 * most <= len(faces) <= 1.02 * most
        assert np.abs(np.linalg.norm(vertices, axis=1) - 1.0).max() < 0.02
    assert len(simplified(sphere, np.zeros(3), len(sphere.faces))[1]) == len(sphere.faces)


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e3])
@pytest.mark.parametrize(("gap", "edges"), [(1e-8, 5), (1e-4, 6)])
def test_vertices_at_the_same_place_are_one(unit, gap, edges):
    """Two triangles of a square; their gap is a fraction of its side."""
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (gap, gap, 0), (1, 1 + gap, 0), (0, 1, 0)])
    found = edges_of(unit * corners, [[0, 1, 2], [3, 4, 5]])
    assert len(found.edges) == edges


@pytest.mark.parametrize("flipped", [False, True])
def test_doubled_faces_count_once_and_those_without_area_never(flipped):
    corners = [(0, 0, 0), (0, 0, 1), (1, 0, 0.5), (-1, 0, 0.5)]
    faces = [[1, 0, 2], [0, 1, 3]]
    again = [face[::-1] for face in faces] if flipped else faces
    edges = edges_of(corners, [*faces, *again, [0, 0, 1]])
    assert kind_of_spine(edges) == (False, True)
    assert len(edges.faces) == 2


@pytest.mark.parametrize("radius", [0.1, 100.0])
@pytest.mark.parametrize("faces", [800, 2500, 8000])
def test_no_part_of_a_fine_mesh_is_lost_whatever_its_unit(faces, radius):
    """In metres, all but one of the truck's parts were collapsed."""
    mesh = example_mesh()
    for _ in range(3):
        mesh = mesh.subdivide()
    mesh.apply_scale(radius / np.abs(mesh.vertices).max())
    vertices, triangles = simplified(mesh, np.zeros(3), faces)
    found = cKDTree(surface_points(trimesh.Trimesh(vertices, triangles, process=False), 20_000))
    distance, _ = found.query(surface_points(mesh, 2_000, seed=1))
    assert distance.max() < 0.06 * radius


def test_a_mesh_of_which_nothing_is_left_is_simplified_again(monkeypatch):
    nothing = np.eye(3, dtype=np.float32), np.zeros((0, 3), np.int32)
    answers = iter([lambda *_, **__: nothing, fast_simplification.simplify])
    monkeypatch.setattr(
        fast_simplification, "simplify", lambda *mesh, **how: next(answers)(*mesh, **how)
    )
    _, triangles = simplified(trimesh.creation.icosphere(3), np.zeros(3), 800)
    assert 700 < len(triangles) <= 800
