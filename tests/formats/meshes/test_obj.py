"""OBJ files as people have them."""

import argparse

import numpy as np
import pytest

import curvireg_torch as cr
from curvireg_torch.cli.options import MESH, add_options, register_options
from curvireg_torch.errors import MeshError, MissingFileError
from tests._support.refusals import refused
from tests._support.tables import text_table
from tests.formats.meshes.pictures import encoded, noise

POINTS = "".join(f"v {x} {y} {z}\n" for x in (0, 3) for y in (0, 2) for z in (0, 1))
UV = "vt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\n"
HALVES = [
    "f 1 3 4\nf 1 4 2\nf 5 6 8\nf 5 8 7\nf 1 2 6\nf 1 6 5\n",
    "f 3 7 8\nf 3 8 4\nf 1 5 7\nf 1 7 3\nf 2 4 8\nf 2 8 6\n",
]
BOX = POINTS + "".join(HALVES)


def textured(faces):
    """The faces with texture coordinates at their corners, one after the other."""
    rows = [line.split()[1:] for line in faces.splitlines()]
    return "".join(f"f {a}/1 {b}/2 {c}/3\n" for a, b, c in rows)


def picture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = noise()
    path.write_bytes(encoded(pixels))
    return pixels


def write(folder, library):
    """A box that is textured by material ``label``."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "a.mtl").write_text(library)
    path = folder / "box.obj"
    path.write_text(f"mtllib a.mtl\n{POINTS}{UV}usemtl label\n{textured(''.join(HALVES))}")
    return path


ENCODINGS = [(name, "\n") for name in ("utf-8-sig", "utf-16", "latin-1", "gbk")]
ENCODINGS += [("utf-8", "\r"), ("utf-8", "\r\n")]


@pytest.mark.parametrize(("encoding", "end"), ENCODINGS)
@pytest.mark.parametrize("first", ["", "mtllib m.mtl\n", "# {}\n", "o {}\n"])
def test_every_encoding_gives_the_same_mesh(write, encoding, end, first):
    name = {"latin-1": "Gehäuse", "gbk": "外壳"}.get(encoding, "part")
    write("m.mtl", "newmtl a\nKd 0.8 0.1 0.1\n")
    text = (first.format(name) + BOX).replace("\n", end)
    mesh = cr.load_mesh(write("a.obj", text.encode(encoding)))
    assert (len(mesh.faces), mesh.extents.tolist()) == (12, [3.0, 2.0, 1.0])


def test_names_of_libraries_may_hold_blanks_and_lost_materials_are_named(write, load):
    write("a.mtl", "newmtl red\nKd 1 0 0\n")
    write("b c.mtl", "newmtl blue\nKd 0 0 1\n")
    body = f"{POINTS}usemtl red\n{HALVES[0]}usemtl blue\n{HALVES[1]}"
    colours = cr.load_mesh(write("a.obj", f"mtllib a.mtl\nmtllib b c.mtl\n{body}")).colours
    assert (colours.corners[:6] == [255, 0, 0]).all()
    assert (colours.corners[6:] == [0, 0, 255]).all()
    assert "lack the material blue" in load(write("a.obj", f"mtllib a.mtl\n{body}"))[1][0]
    nameless = body.replace("usemtl blue", "usemtl")  # is no material, and so none is lost
    colours = cr.load_mesh(write("a.obj", f"mtllib a.mtl\n{nameless}")).colours
    assert (colours.corners[6:] == 255).all()


def test_names_may_hold_number_signs_and_remarks_stand_behind_them(write, load):
    write("a.mtl", "newmtl Material #27 # red\nKd 1 0 0 # of the lid\n")
    mesh, said = load(
        write("a.obj", f"mtllib a.mtl # it\n{POINTS}usemtl Material #27\n{HALVES[0]}")
    )
    assert (mesh.colours.corners == [255, 0, 0]).all()
    assert said == []
    write("a.mtl", "newmtl red\nKd 1 0 0\n")
    mesh, _ = load(write("a.obj", f"mtllib a.mtl\n{POINTS}usemtl red #lid\n{HALVES[0]}"))
    assert (mesh.colours.corners == [255, 0, 0]).all()


TEXTURE_OPTIONS = """
                                                               | [1, 1] | [0, 0]
-s 1.000000 1.000000 1.000000                                  | [1, 1] | [0, 0]
-s 2 3 -o 0.25 0.5 0                                           | [2, 3] | [0.25, 0.5]
"-s\\t2\\t3\\t1\\t"                                           | [2, 3] | [0, 0]
-s 3                                                           | [3, 1] | [0, 0]
-s 3 5 7                                                       | [3, 5] | [0, 0]
-o 3 5 -s 2                                                    | [2, 1] | [3, 5]
-o .5 -bm 1.5 -clamp on                                        | [1, 1] | [0.5, 0]
-blendu on -blendv off -mm 0 1 -texres 512 -imfchan l -t 1 1 1 | [1, 1] | [0, 0]
"""


@pytest.mark.parametrize(("options", "scale", "offset"), text_table(TEXTURE_OPTIONS))
@pytest.mark.parametrize(
    "name",
    ["label.png", "my label.png", "LABEL.PNG", '"label.png"', "maps\\label.png", "./label.png"],
)
def test_options_of_a_texture_precede_its_name(tmp_path, options, scale, offset, name):
    folder = tmp_path / "maps" if "maps" in name else tmp_path
    file = name.replace("maps\\", "").strip('"')
    pixels = picture(folder / (file.lower() if name.isupper() else file))
    path = write(tmp_path, f"newmtl label\nKd 1 1 1\nmap_Kd {options} {name}\n")
    mesh = cr.load_mesh(path)
    colours = mesh.colours
    np.testing.assert_array_equal(colours.textures[0], pixels)
    expected = np.array([[0, 0], [1, 0], [0, 1]]) * scale + offset
    np.testing.assert_allclose(colours.uv, np.broadcast_to(expected, (12, 3, 2)), atol=1e-6)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "gbk"])
def test_a_library_in_another_encoding_finds_its_texture(tmp_path, encoding):
    name = "标签.png" if encoding == "gbk" else "Gehäuse.png"
    picture(tmp_path / name)
    path = write(tmp_path, "")
    (tmp_path / "a.mtl").write_bytes(f"newmtl label\nmap_Kd {name}\n".encode(encoding))
    mesh = cr.load_mesh(path)
    assert mesh.has_colours


def test_textures_outside_of_the_folder_are_named_and_found_where_their_folder_is_given(
    tmp_path, load
):
    picture(tmp_path / "images" / "label.png")
    for name in (tmp_path / "images" / "label.png", "C:\\art\\label.png"):
        path = write(tmp_path / "models", f"newmtl label\nmap_Kd {name}\n")
        mesh, (text,) = load(path)
        assert not mesh.has_colours
        assert "label.png" in text
        assert [warning.kind for warning in mesh.warnings] == ["texture"]
        mesh = cr.load_mesh(path, textures=tmp_path / "images")
        assert mesh.has_colours
    path = write(tmp_path / "models", "newmtl label\nmap_Kd ../images/label.png\n")
    assert load(path, textures=tmp_path)[0].has_colours
    path.write_text(path.read_text().replace("mtllib a.mtl", "mtllib ../a.mtl"))
    (path.parent / "a.mtl").rename(tmp_path / "a.mtl")
    assert load(path, textures=tmp_path)[0].has_colours


def test_colours_behind_the_coordinates(write, load):
    for scale in (1, 255):
        shaded = [
            f"{line} {k % 2 * scale} 0 {scale}\n" for k, line in enumerate(POINTS.splitlines())
        ]
        colours = load(write("a.obj", "".join([*shaded, *HALVES])))[0].colours
        found = set(map(tuple, colours.corners.reshape(-1, 3).tolist()))
        assert found == {(0, 0, 255), (255, 0, 255)}


def test_corners_of_several_forms_in_one_file(write, load):
    plain, _ = load(write("plain.obj", BOX))
    faces = "".join(HALVES).replace("f 1 3 4\n", "f 1/1 3/2/1 4\n")
    faces = faces.replace("f 3 8 4\n", "f 3//1 8/ 4//\n")
    mesh, _ = load(write("a.obj", POINTS + UV + "vn 0 0 1\n" + faces))
    np.testing.assert_array_equal(mesh.faces, plain.faces)


DAMAGED = """
v 1 2               | a vertex has fewer than 3 coordinates
v 0,5 1,0 2,0       | decimal commas
v a b c             | a coordinate is not a number
f 1 2 9             | a vertex that the file lacks
f 1 2 -99           | a vertex that the file lacks
f 1/9 2/9 3/9       | that the file lacks
f 0 1 2             | vertex 0; OBJ files count from 1
f 1 2 0             | vertex 0; OBJ files count from 1
f 3/1/1 0/1/1 1/1/1 | vertex 0; OBJ files count from 1
f 0 1 2 3           | vertex 0; OBJ files count from 1
"""


@pytest.mark.parametrize(("line", "words"), text_table(DAMAGED))
def test_damaged_lines_are_refused(refused, line, words):
    refused("a.obj", f"{BOX}vt 0 0\n{line}\n", rf"a\.obj: cannot be read as a mesh .*{words}")


def test_an_obj_of_many_parts_is_refused(refused):
    for key in ("o", "g", "usemtl", "mtllib"):
        parts = "".join(f"{key} p{k}\nf 1 2 3\n" for k in range(10_001))
        refused("a.obj", POINTS + parts, "more than 10,000 parts; join them")


def test_options_of_the_command_line_reach_the_reader(tmp_path):
    picture(tmp_path / "images" / "label.png")
    path = write(tmp_path / "models", "newmtl label\nmap_Kd ../images/label.png\n")
    parser = argparse.ArgumentParser()
    add_options(parser, *MESH)
    arguments = parser.parse_args(["--textures", str(tmp_path / "images"), "--unit", "m"])
    mesh = register_options(arguments).load_mesh(path)
    assert mesh.has_colours
    arguments = parser.parse_args(["--link", "tip"])
    with refused("only a URDF has links", MeshError):
        register_options(arguments).load_mesh(path)
    with refused("no such folder; check the folder of the textures", MissingFileError):
        cr.load_mesh(path, textures=tmp_path / "nowhere")
