"""PLY files as scanners write them."""

import numpy as np
import pytest

import curvireg_torch as cr
from tests.formats.meshes.pictures import encoded, noise

POINTS = [(0, 0, 0), (4, 0, 0), (4, 2, 0), (0, 2, 0)]
FACES = "3 0 1 2\n3 0 2 3\n"
RGB = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
UV = "property float s\nproperty float t\n"
SHADES = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (51, 102, 153)]


def header(vertex="", face="", *, points=4, count=2, comments="", kind="ascii"):
    columns = "".join(f"property float {axis}\n" for axis in "xyz") + vertex
    text = f"ply\nformat {kind} 1.0\n{comments}element vertex {points}\n{columns}"
    text += f"element face {count}\n"
    return f"{text}property list uchar int vertex_indices\n{face}end_header\n"


def rows(extra):
    return "".join(f"{x} {y} {z} {more}\n" for (x, y, z), more in zip(POINTS, extra, strict=True))


@pytest.mark.parametrize("prefix", ["", "diffuse_"])
@pytest.mark.parametrize("short", [False, True])
@pytest.mark.parametrize(
    ("kind", "scale"), [("uchar", 1), ("float", 1 / 255), ("ushort", 1), ("ushort", 257)]
)
def test_colours_under_every_name(write, prefix, short, kind, scale):
    names = [
        f"{prefix}{name[0] if short and not prefix else name}" for name in ("red", "green", "blue")
    ]
    vertex = "".join(f"property {kind} {name}\n" for name in names)
    extra = [" ".join(f"{shade * scale:g}" for shade in shades) for shades in SHADES]
    mesh = cr.load_mesh(write("a.ply", header(vertex) + rows(extra) + FACES))
    np.testing.assert_array_equal(mesh.colours.corners, np.array(SHADES)[mesh.faces])


@pytest.mark.parametrize(("kind", "order"), [("little", "<"), ("big", ">")])
def test_colours_of_16_bits_are_scaled_in_any_byte_order(write, kind, order):
    text = header(RGB.replace("uchar", "ushort"), kind=f"binary_{kind}_endian")
    shades = 257 * np.array(SHADES)
    points = [(*point, *shade) for point, shade in zip(POINTS, shades, strict=True)]
    vertices = np.array(points, np.dtype("f4,f4,f4,u2,u2,u2").newbyteorder(order))
    faces = np.array([(3, 0, 1, 2), (3, 0, 2, 3)], np.dtype("u1,i4,i4,i4").newbyteorder(order))
    mesh = cr.load_mesh(write("a.ply", text.encode() + vertices.tobytes() + faces.tobytes()))
    np.testing.assert_array_equal(mesh.colours.corners, np.array(SHADES)[mesh.faces])


def pictures(folder):
    for k in range(2):
        (folder / f"{k}.png").write_bytes(encoded(noise(k)))
    return noise(0), noise(1)


def test_two_textures_are_read_or_named(tmp_path, write, load):
    pixels = pictures(tmp_path)
    comments = "comment TextureFile 0.png\ncomment TextureFile 1.png\n"
    face = "property list uchar float texcoord\n"
    faces = "3 0 1 2 6 0 0 1 0 1 1 {}\n3 0 2 3 6 0 0 1 1 0 .5 {}\n"
    text = header(face=face + "property int texnumber\n", comments=comments) + rows([""] * 4)
    mesh, texts = load(write("a.ply", text + faces.format(1, 0)))
    colours = mesh.colours
    assert not texts
    for k, number in enumerate(colours.texture):
        np.testing.assert_array_equal(colours.textures[number], pixels[1 - k])
    assert colours.uv.tolist() == [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 0.5]]]
    text = header(face=face, comments=comments) + rows([""] * 4) + faces.format("", "")
    mesh, texts = load(write("a.ply", text))
    assert "names 2 textures and does not say which face has which" in texts[0]
    assert mesh.has_colours
    text = header(comments=comments) + rows([""] * 4) + FACES
    assert "has no texture coordinates" in load(write("a.ply", text))[1][0]


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_texture_coordinates_of_vertices(tmp_path, write, names):
    (pixels, _) = pictures(tmp_path)
    vertex = "".join(f"property float {name}\n" for name in names)
    text = header(vertex, count=1, comments="comment TextureFile 0.png\n")
    mesh = cr.load_mesh(write("a.ply", text + rows(["0 0", "1 0", "1 1", "0 1"]) + "4 0 1 2 3\n"))
    colours = mesh.colours
    np.testing.assert_array_equal(colours.textures[0], pixels)
    np.testing.assert_allclose(
        colours.uv, np.asarray(mesh.vertices)[mesh.faces][..., :2] / [4, 2], atol=1e-6
    )


def test_concave_faces_keep_their_texture_coordinates(tmp_path, write, load):
    pictures(tmp_path)
    face = "property list uchar float texcoord\n"
    text = header(face=face, comments="comment TextureFile 0.png\n")
    points = "0 0 0\n1 2 0\n0 1 0\n-1 2 0\n"
    faces = "4 0 1 2 3 8 0 0 .1 .2 0 .1 -.1 .2\n3 0 1 2 6 0 0 .1 .2 0 .1\n"
    mesh, _ = load(write("a.ply", text + points + faces))
    assert (len(mesh.faces), mesh.surface.area) == (3, pytest.approx(1.5))
    # a tenth of the coordinates
    np.testing.assert_allclose(mesh.colours.uv, mesh.surface.triangles[..., :2] / 10, atol=1e-6)


@pytest.mark.parametrize("encoding", ["latin-1", "gbk", "utf-8", "utf-8-sig"])
def test_remarks_in_any_encoding(write, encoding):
    name = "外壳" if encoding == "gbk" else "Gehäuse"
    write(f"{name}.png", encoded(noise()))
    comments = f"comment made for {name}\nobj_info {name}\ncomment TextureFile {name}.png\n"
    text = header(UV, comments=comments) + rows(["0 0", "1 0", "1 1", "0 1"]) + FACES
    mesh = cr.load_mesh(write("a.ply", text.encode(encoding)))
    assert mesh.has_colours


@pytest.mark.parametrize(
    "content",
    [
        "",
        "ply\n",
        "ply\nformat ascii 1.0\nend_header\n",
        header().replace("float x", "float q") + rows([""] * 4),
    ],
)
def test_damaged_files_are_refused(refused, content):
    refused("a.ply", content, r"a\.ply")


def test_headers_of_many_columns_are_refused(refused):
    columns = "".join(f"property list uchar float a{k}\n" for k in range(501))
    refused(
        "a.ply",
        header(columns, kind="binary_little_endian"),
        "more than 500 kinds of rows or columns",
    )
