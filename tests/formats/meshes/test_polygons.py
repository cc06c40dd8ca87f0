"""Polygons become triangles; what trimesh reads wrongly is rewritten or refused."""

import itertools
import struct

import numpy as np
import pytest
from PIL import Image

import curvireg_torch as cr
from curvireg_torch.formats.meshes.polygons import triangulated
from tests.formats.meshes.test_obj import POINTS
from tests.formats.meshes.test_ply import RGB, header

CONVEX = np.array([[0, 0], [3, 0], [4, 2], [2, 4], [0, 2]], dtype=float)
DART = np.array([[0, 0], [1, 2], [0, 1], [-1, 2]], dtype=float)
U = np.array([[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]], dtype=float)


def square_with_hole(n):
    square = np.array([[0, 0], [10, 0], [10, 10], [0, 10.0]])
    angle = -np.linspace(0, 2 * np.pi, n, endpoint=False) - 3 * np.pi / 4
    hole = 5 + 2 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([square, square[:1], hole, hole[:1]])


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("signs", list(itertools.product([1, -1], repeat=2)))
def test_triangles_cover_polygons_once_on_their_side_and_convex_ones_are_fans(order, signs):
    """Vectors of area that add up to that of the polygon, and of which none is turned over."""
    rng = np.random.default_rng(0)
    stars = [
        np.exp(1j * np.sort(rng.uniform(0, 2 * np.pi, n))) * rng.uniform(0.2, 1, n)
        for n in (4, 5, 6, 9, 60)
    ]
    for flat in (
        CONVEX,
        DART,
        np.roll(DART, 1, axis=0),
        U,
        *map(square_with_hole, (3, 8, 40)),
        *(star.view(float).reshape(-1, 2) for star in stars),
    ):
        tilted = (np.insert(flat, 2, 0.3 * flat.sum(axis=1), axis=1) * [*signs, 1])[:, order]
        corners = np.array([0, 1, 2, *range(len(tilted))])
        picked, owner = triangulated(tilted, corners, np.array([3, len(tilted)]))
        faces = picked[owner == 1]
        a, b, c = np.moveaxis(tilted[corners[faces]], 1, 0)
        areas = np.cross(b - a, c - a)
        whole = np.cross(tilted, np.roll(tilted, -1, axis=0)).sum(axis=0)
        np.testing.assert_allclose(areas.sum(axis=0), whole, atol=1e-9)
        assert (areas @ whole > 0).all()
        if flat is CONVEX:
            assert corners[faces].tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]


def prism():
    """A U of 3 x 3, 1 thick: two concave ends, eight walls."""
    vertices = np.concatenate([np.insert(U, 2, 0.0, axis=1), np.insert(U, 2, 1.0, axis=1)])
    walls = [[i, (i + 1) % 8, 8 + (i + 1) % 8, 8 + i] for i in range(8)]
    return vertices, [list(range(7, -1, -1)), list(range(8, 16)), *walls]


def write(path, kind):
    vertices, faces = prism()
    points = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in vertices)
    lists = "".join(f"{len(f)} {' '.join(map(str, f))}\n" for f in faces)
    if kind.endswith("with colours"):
        lists = "".join(f"{line} 255 0 0\n" for line in lists.splitlines())
    if kind.startswith("off"):
        path.write_text(f"OFF # a U\n16 10 0\n\n{points}{lists}")
    elif kind.startswith("obj"):
        first = -16 if kind == "obj counted back" else 1
        corner = "{0}/{0}/{0}" if kind == "obj with texture" else "{0}"
        lines = ["f " + " ".join(corner.format(i + first) for i in f) for f in faces]
        if kind == "obj continued":
            lines = [line.replace(" 5 ", " 5 \\\n") for line in lines]
        uv = "".join(f"vt {x / 4:g} {y / 4:g}\nvn 0 0 1\n" for x, y, _ in vertices)
        uv = uv if kind == "obj with texture" else ""
        text = "".join(f"v {p}\n" for p in points.splitlines())
        path.write_text(text + uv + "\n".join(lines) + "\n")
    else:
        colour = RGB if kind == "ply with colours" else ""
        path.write_text(header(face=colour, points=16, count=10) + points + lists)


KINDS = ["off", "off with colours", "obj", "obj counted back", "obj continued", "obj with texture"]
KINDS += ["ply", "ply with colours"]


@pytest.mark.parametrize("kind", KINDS)
def test_load_mesh_leaves_the_gap_of_a_concave_face_open(tmp_path, load, kind):
    path = tmp_path / f"u.{kind[:3]}"
    write(path, kind)
    mesh, said = load(path)
    assert ("colours, which are not read" in "".join(said)) == (kind == "off with colours")
    # fans would cover more
    assert (mesh.surface.area, len(mesh.faces)) == (pytest.approx(2 * 7 + 16), 2 * 6 + 8 * 2)
    if kind == "ply with colours":
        assert (mesh.colours.corners == [255, 0, 0]).all()


def test_divided_faces_of_an_obj_keep_texture_coordinates_at_their_corners(tmp_path):
    path = tmp_path / "u.obj"
    write(path, "obj with texture")
    pixels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3) * 5
    Image.fromarray(pixels).save(tmp_path / "a.png")
    (tmp_path / "a.mtl").write_text("newmtl skin\nmap_Kd a.png\n")
    path.write_text("mtllib a.mtl\nusemtl skin\n" + path.read_text())
    mesh = cr.load_mesh(path)
    uv = mesh.colours.uv
    np.testing.assert_allclose(uv, np.asarray(mesh.vertices)[mesh.faces][..., :2] / 4, atol=1e-6)
    assert mesh.surface.area == pytest.approx(30)


def binary_ply(faces, vertices):
    head = header(points=len(vertices), count=len(faces), kind="binary_big_endian").encode()
    body = vertices.astype(">f4").tobytes() + b"".join(
        struct.pack(f">B{len(f)}i", len(f), *f) for f in faces
    )
    return head + body


def test_load_mesh_reads_binary_ply_of_one_number_of_corners(write, refused):
    vertices, faces = prism()
    mesh = cr.load_mesh(write("u.ply", binary_ply(faces[:2], vertices)))
    assert mesh.surface.area == pytest.approx(2 * 7)
    quads = binary_ply([[0, 1, 2, 3], [4, 5, 6], [7, 8, 9, 10, 11]], vertices)  # of 12 corners
    refused("u.ply", quads, "different numbers of corners are not read; export triangles")
    refused("u.ply", binary_ply(faces, vertices), "different numbers of corners: export triangles")


SIDES = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]


@pytest.mark.parametrize("line", ["f {}", "  f {}", "\tf {}", "f {} # side", "f\t{}"])
def test_load_mesh_reads_every_face_of_an_obj(write, line):
    """trimesh drops indented faces and refuses comments behind them."""
    rows = [(line if k % 2 else "f {}").format(side) for k, side in enumerate(SIDES)]
    mesh = cr.load_mesh(write("box.obj", POINTS + "\n".join(rows)))
    assert (len(mesh.faces), abs(mesh.surface.volume)) == (12, pytest.approx(6.0))


@pytest.mark.parametrize("kind", ["off", "ply"])
def test_load_mesh_refuses_corners_that_do_not_exist(tmp_path, refused, kind):
    path = tmp_path / f"u.{kind}"
    write(path, kind)
    damaged = path.read_bytes().replace(b"\n8 7 6", b"\n8 99 6")
    refused(path.name, damaged, "a face names a vertex that the file lacks")
