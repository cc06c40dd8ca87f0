import struct
import time

import numpy as np
import pytest
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.errors import MeshError
from curvireg_torch.mesh.files import with_triangles
from curvireg_torch.mesh.polygons import triangulate

U = np.array([[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]], dtype=float)


def areas(polygon: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(polygon[triangles], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)


def true_area(flat: np.ndarray) -> float:
    x, y = flat.T
    return 0.5 * abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))


def star(n: int, rng: np.random.Generator) -> np.ndarray:
    angle, radius = np.sort(rng.uniform(0, 2 * np.pi, n)), rng.uniform(0.2, 1, n)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def comb(teeth: int) -> np.ndarray:
    x = np.arange(2 * teeth + 1)
    return np.concatenate([np.stack([x, np.where(x % 2, 9.0, 1.0)], axis=-1), [[x[-1], 0], [0, 0]]])


def square_with_hole(n: int) -> np.ndarray:
    square = np.array([[0, 0], [10, 0], [10, 10], [0, 10.0]])
    angle = -np.linspace(0, 2 * np.pi, n, endpoint=False) - 3 * np.pi / 4
    hole = 5 + 2 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([square, square[:1], hole, hole[:1]])


WITH_STRAIGHT_CORNERS = np.array([[0, 0], [1, 0], [2, 0], [4, 0], [4, 4], [2, 4], [2, 2], [1, 2], [0, 2], [0, 1.0]])


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_triangulate_covers_polygons_once_in_their_orientation(axis: int, sign: int) -> None:
    rng = np.random.default_rng(0)
    stars = [star(n, rng) for n in (4, 5, 6, 9, 60)]
    for flat in (U, comb(30), WITH_STRAIGHT_CORNERS, *map(square_with_hole, (3, 8, 40)), *stars):
        polygon = np.insert(flat[::sign], axis, 0.3 * flat[::sign].sum(axis=1), axis=1)  # in a tilted plane
        triangles = np.array(triangulate(polygon[None])[0])
        assert triangles.shape == (len(flat) - 2, 3)
        assert set(triangles.ravel()) == set(range(len(flat))), "neighbouring faces share these corners"
        # A plane over (u, v) of slope (0.3, 0.3): area grows by sqrt(1.18). Equal sums mean that none overlap.
        assert areas(polygon, triangles).sum() == pytest.approx(true_area(flat) * 1.18**0.5, rel=1e-9)
        normals = np.cross(*(np.diff(polygon[triangles], axis=1).swapaxes(0, 1)))
        normal = np.cross(polygon, np.roll(polygon, -1, axis=0)).sum(axis=0)
        assert (normals @ normal >= -1e-9).all()


def test_triangulate_is_batch_independent() -> None:
    rng = np.random.default_rng(1)
    polygons = np.stack([np.insert(star(7, rng), 2, 0.0, axis=1) for _ in range(50)])
    assert triangulate(polygons) == [triangulate(polygon[None])[0] for polygon in polygons]


def test_triangulate_divides_convex_and_broken_polygons_into_fans() -> None:
    square = np.array([[[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])
    for polygon in (square, square * np.nan, square * 0):
        assert triangulate(polygon)[0] == [[0, 1, 2], [0, 2, 3]]


def test_triangulate_takes_little_time_for_polygons_that_cross_themselves() -> None:
    rng = np.random.default_rng(0)
    angle = np.arange(1999) * 2 * np.pi * 998 / 1999
    crossing = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    start = time.perf_counter()
    for flat in (crossing, rng.random((2000, 2)), rng.integers(0, 5, (2000, 2)).astype(float)):
        triangles = np.array(triangulate(np.insert(flat, 2, 0.0, axis=1)[None])[0])
        assert 0 < len(triangles) <= len(flat) - 2
        assert 0 <= triangles.min() <= triangles.max() < len(flat)
    assert time.perf_counter() - start < 5


def test_triangulate_bounds_the_corners_of_concave_polygons() -> None:
    angle = np.linspace(0, 2 * np.pi, 5000, endpoint=False)
    disc = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    assert len(triangulate(disc[None])[0]) == 4998
    disc[7] *= 0.5
    with pytest.raises(ValueError, match="5000 corners"):
        triangulate(disc[None])


def prism() -> tuple[np.ndarray, list[list[int]]]:
    """A U of 3 x 3, 1 thick: two concave ends, eight walls."""
    vertices = np.concatenate([np.insert(U, 2, 0.0, axis=1), np.insert(U, 2, 1.0, axis=1)])
    walls = [[i, (i + 1) % 8, 8 + (i + 1) % 8, 8 + i] for i in range(8)]
    return vertices, [list(range(7, -1, -1)), list(range(8, 16)), *walls]


def write(path, kind: str) -> None:
    vertices, faces = prism()
    points = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in vertices)
    lists = "".join(f"{len(f)} {' '.join(map(str, f))}\n" for f in faces)
    if kind == "off":
        path.write_text(f"OFF # a U\n16 10 0\n\n{points}{lists}")
    elif kind == "off with colours":
        lists = "".join(f"{line} 255 0 0\n" for line in lists.splitlines())
        path.write_text(f"OFF\n16 10 0\n{points}{lists}")
    elif kind.startswith("obj"):
        first = -16 if kind == "obj counted back" else 1
        corner = "{0}/{0}/{0}" if kind == "obj with texture" else "{0}"
        lines = ["f " + " ".join(corner.format(i + first) for i in f) for f in faces]
        if kind == "obj continued":
            lines = [line.replace(" 5 ", " 5 \\\n") for line in lines]
        uv = "".join(f"vt {x / 4:g} {y / 4:g}\nvn 0 0 1\n" for x, y, _ in vertices) * (kind == "obj with texture")
        path.write_text("".join(f"v {p}\n" for p in points.splitlines()) + uv + "\n".join(lines) + "\n")
    else:
        order = {"ply": "", "ply big": ">", "ply little": "<", "ply with texture": "<"}[kind]
        form = {"": "ascii", ">": "binary_big_endian", "<": "binary_little_endian"}[order]
        texture = kind == "ply with texture"
        header = f"ply\nformat {form} 1.0\ncomment a U\nelement vertex 16\n"
        header += "".join(f"property float {axis}\n" for axis in "xyz") + "element face 10\n"
        header += "property list uchar int vertex_indices\n"
        header += "property list uchar float texcoord\nproperty uchar red\n" * texture + "end_header\n"
        if order == "":
            path.write_text(header + points + lists)
            return
        body = b"".join(struct.pack(order + "3f", *v) for v in vertices)
        for f in faces:
            body += struct.pack(f"{order}B{len(f)}i", len(f), *f)
            if texture:
                uv = (vertices[f, :2] / 4).ravel().tolist()
                body += struct.pack(f"{order}B{len(uv)}fB", len(uv), *uv, 7)
        path.write_bytes(header.encode() + body)


KINDS = ["off", "off with colours", "obj", "obj counted back", "obj continued", "obj with texture"]
KINDS += ["ply", "ply big", "ply little", "ply with texture"]


def silhouette(mesh: trimesh.Trimesh) -> int:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([-1.5, -1.5, 8.0])
    K = cr.camera_matrix(80.0, 80.0, 31.5, 31.5, dtype=torch.float64)
    return int((cr.render_depth(mesh, T, K, (64, 64), renderer="embree") > 0).sum())


@pytest.mark.parametrize("kind", KINDS)
def test_load_mesh_leaves_the_gap_of_a_concave_face_open(tmp_path, kind: str) -> None:
    vertices, faces = prism()
    whole = trimesh.creation.box((3, 3, 1), transform=trimesh.transformations.translation_matrix((1.5, 1.5, 0.5)))
    gap = trimesh.creation.box((1, 2, 1.01), transform=trimesh.transformations.translation_matrix((1.5, 2, 0.5)))
    path = tmp_path / f"u.{kind[:3]}"
    write(path, kind)
    mesh = cr.load_mesh(path)
    fans = [[f[0], f[i], f[i + 1]] for f in faces for i in range(1, len(f) - 1)]
    true, filled = silhouette(mesh), silhouette(trimesh.Trimesh(vertices, fans, process=False))
    assert filled - true > 150
    # The U leaves free the pixels of the gap, except where perspective shows its walls.
    assert silhouette(whole) - silhouette(gap) <= true + 60
    assert mesh.area == pytest.approx(2 * 7 + 16)
    assert len(mesh.faces) == 2 * 6 + 8 * 2


@pytest.mark.parametrize("kind", ["obj with texture", "ply with texture"])
def test_with_triangles_keeps_texture_coordinates_at_their_corners(tmp_path, kind: str) -> None:
    path = tmp_path / f"u.{kind[:3]}"
    write(path, kind)
    path.write_bytes(with_triangles(path.read_bytes(), path.suffix))
    mesh = trimesh.load(path, process=False)
    np.testing.assert_allclose(mesh.visual.uv, mesh.vertices[:, :2] / 4, atol=1e-6)
    assert mesh.area == pytest.approx(30)


@pytest.mark.parametrize("kind", ["off", "obj", "ply", "ply little"])
def test_load_mesh_refuses_damaged_polygons(tmp_path, kind: str) -> None:
    path = tmp_path / f"u.{kind[:3]}"
    write(path, kind)
    data = path.read_bytes()
    for damaged in (data.replace(b"\n8 7 6", b"\n8 99 6").replace(b"f 8 7 ", b"f 8 99 "), data[: len(data) - 12]):
        if kind == "ply little" and damaged == data:
            damaged = data.replace(struct.pack("<Bi", 8, 7), struct.pack("<Bi", 8, 99))
        if kind == "obj" and damaged == data[:-12]:
            continue  # a shorter OBJ is another OBJ
        path.write_bytes(damaged)
        with pytest.raises(MeshError, match=path.name):
            cr.load_mesh(path)


def test_with_triangles_leaves_triangles_unchanged(tmp_path) -> None:
    box = trimesh.creation.box()
    for suffix, options in ((".obj", {}), (".off", {}), (".ply", {"encoding": "ascii"}), (".ply", {})):
        box.export(tmp_path / f"a{suffix}", **options)
        data = (tmp_path / f"a{suffix}").read_bytes()
        assert with_triangles(data, suffix) == data
