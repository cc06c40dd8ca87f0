"""Where two readings are possible: transforms whose order matters, which of two statements wins,
and on which side a face lies."""

import math
from io import BytesIO

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from PIL import Image

import curvireg_torch as cr
from curvireg_torch.formats.meshes.colours import SurfaceColours, colours_of_parts, texture_pixels
from curvireg_torch.formats.meshes.source import MeshSource, ReadMesh, colour_bytes
from curvireg_torch.utils.extras import is_installed
from tests._support.tables import text_table
from tests.formats.meshes.packages import mesh_of_robot, model, solid, threemf
from tests.formats.meshes.pictures import painted
from tests.formats.meshes.test_gltf import TRIANGLE, Tree, coordinates, skinned, textured
from tests.formats.meshes.test_ply import FACES, RGB, UV, header, rows
from tests.formats.meshes.test_usd import BOUND, MAP, MATERIAL, square, write_print

needs_usd = pytest.mark.skipif(not is_installed("pxr"), reason="usd-core is not installed")
pytestmark = pytest.mark.usefixtures("here")

RED = [255, 0, 0]
GREEN = [0, 255, 0]
BLUE = [0, 0, 255]
WHITE = [255, 255, 255]
# about z by 90 degrees: x becomes y
QUARTER = [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]


def first_corners(mesh):
    """The colours of the first corner of each face."""
    return mesh.colours.corners[:, 0].tolist()


def textures(mesh):
    """The colour of each face's texture in its first texel; white where there is none."""
    colours = mesh.colours
    plain = [texture[0, 0].tolist() for texture in colours.textures]
    return [plain[k] if k >= 0 else WHITE for k in colours.texture]


# glTF


@pytest.mark.parametrize(
    ("nodes", "expected"),
    [
        # x of 1 is stretched to 2 and becomes y; y of 1 is stretched to 3 and becomes -x
        (
            [{"mesh": 0, "rotation": QUARTER, "scale": [2, 3, 5], "translation": [10, 0, 0]}],
            [[10, 0, 0], [10, 2, 0], [7, 0, 0]],
        ),
        (
            [
                {"children": [1], "rotation": QUARTER, "translation": [0, 0, 1]},
                {"mesh": 0, "translation": [5, 0, 0]},
            ],
            [[0, 5, 1], [0, 6, 1], [-1, 5, 1]],
        ),
    ],
)
def test_a_node_is_scaled_then_turned_then_moved_in_the_frame_of_its_parent(
    loaded, nodes, expected
):
    tree = Tree()
    tree.part(None, TRIANGLE)
    tree.content["nodes"] = nodes
    mesh = loaded(tree)
    assert_allclose(mesh.vertices, expected, atol=1e-6)


def test_a_joint_moves_what_its_inverse_bind_matrix_has_moved(loaded):
    bind = np.eye(4)
    bind[3, 0] = 4.0  # by column: a shift along x
    tree = skinned([0] * 4, [1, 0, 0, 0], {"rotation": QUARTER}, inverseBindMatrices=bind)
    mesh = loaded(tree)
    assert_allclose(mesh.vertices, [[0, 4, 0], [0, 5, 0], [-1, 4, 0]], atol=1e-6)


def test_joints_stand_in_the_frames_of_their_parents(loaded):
    """The place of the node that has the skin does not count; another node shows the mesh as it
    is stored."""
    joints = [[0] * 4, [1] * 4, [1] * 4]
    nodes = {"translation": [0, 5, 0], "children": [2]}, {"translation": [3, 0, 0]}
    binds = np.tile(np.eye(4), (2, 1, 1))
    binds[1, 3, 0] = -1.0  # of a joint that stood at x = 1
    tree = skinned(joints, [1, 0, 0, 0], *nodes, inverseBindMatrices=binds)
    tree.content["nodes"][0]["translation"] = [100, 0, 0]
    tree.content["nodes"].append({"mesh": 0})
    tree.content["scenes"] = [{"nodes": [0, 1, 3]}]
    mesh = loaded(tree)
    expected = [[0, 5, 0], [3, 5, 0], [2, 6, 0], *TRIANGLE]
    assert_allclose(mesh.vertices, expected, atol=1e-6)


def test_weights_of_joints_are_shares(loaded):
    tree = skinned([0, 1, 0, 0], [3, 1, 0, 0], {}, {"translation": [0, 0, 4]})
    mesh = loaded(tree)
    assert_allclose(mesh.vertices, np.add(TRIANGLE, [0, 0, 1]), atol=1e-6)


def test_the_least_integer_of_a_fraction_is_minus_one(loaded):
    tree = Tree()
    positions = tree.array([[-128, 0, 0], [127, 0, 0], [0, -127, 0]], "b", normalized=True)
    tree.content["extensionsRequired"] = ["KHR_mesh_quantization"]
    tree.content["meshes"] = [{"primitives": [{"attributes": {"POSITION": positions}}]}]
    mesh = loaded(tree)
    assert mesh.bounds.tolist() == [[-1, -1, 0], [1, 0, 0]]


def test_the_set_that_a_transform_names_wins(loaded):
    for more, first in (
        ({}, 0.0),
        ({"texCoord": 1}, 0.25),
        ({"texCoord": 0, "extensions": {"KHR_texture_transform": {"texCoord": 1}}}, 0.25),
        ({"texCoord": 1, "extensions": {"KHR_texture_transform": {"texCoord": 0}}}, 0.0),
    ):
        mesh = loaded(textured(more))
        assert coordinates(mesh)[0, 0] == first
        assert first_corners(mesh) == [RED], "a texture times the factor of the material"


def test_specular_colours_win_over_metallic_ones(loaded):
    specular = {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0, 0, 1, 1]}}
    metallic = {"baseColorFactor": [1, 0, 0, 1], "baseColorTexture": {"index": 0}}
    material = {"pbrMetallicRoughness": metallic, "extensions": specular}
    mesh = loaded(textured({}, material))
    assert (first_corners(mesh), textures(mesh)) == ([BLUE], [WHITE])
    assert mesh.colours.textures == ()


def test_parts_keep_their_own_colours_and_textures(loaded):
    """The second picture lies in a view, as in GLB."""
    tree = textured({})
    tree.content["materials"] += [
        {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 1, 1]}},
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 1}}},
    ]
    tree.content["textures"] += [{"source": 1}]
    for material in (1, 2, None):
        part = tree.part(None, TRIANGLE, **({} if material is None else {"material": material}))
        part["attributes"]["TEXCOORD_0"] = 1
    view = tree.array(np.frombuffer(painted(GREEN), np.uint8), "B")
    tree.content["images"] += [{"bufferView": view}]
    mesh = loaded(tree)
    assert mesh.colours.texture.tolist() == [0, -1, 1, -1]
    assert textures(mesh) == [WHITE, WHITE, GREEN, WHITE]
    assert first_corners(mesh) == [RED, BLUE, WHITE, WHITE]


def test_a_picture_as_webp_wins(write, loaded):
    tree = textured({})
    tree.content["images"] += [{"uri": "b.png"}]
    write("b.png", painted(GREEN))
    tree.content["textures"] = [{"source": 0, "extensions": {"EXT_texture_webp": {"source": 1}}}]
    assert textures(loaded(tree)) == [GREEN]


# OBJ


POINTS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\n"


def test_of_two_materials_of_a_name_the_first_counts(write):
    write("red.mtl", "newmtl m\nKd 1 0 0\n")
    write("blue.mtl", "newmtl m\nKd 0 0 1\n")
    for names, colour in (("red.mtl blue.mtl", RED), ("blue.mtl red.mtl", BLUE)):
        mesh = cr.load_mesh(write("a.obj", f"mtllib {names}\n{POINTS}f 1 2 3\n"))
        assert first_corners(mesh) == [colour]


def test_colours_of_vertices_win_over_those_of_materials(write):
    write("a.mtl", "newmtl m\nKd 1 0 0\n")
    points = POINTS.replace(" 0\n", " 0 0 1 0\n")
    mesh = cr.load_mesh(write("a.obj", f"mtllib a.mtl\n{points}f 1 2 3\n"))
    assert first_corners(mesh) == [GREEN]


def test_a_face_has_a_texture_if_all_its_corners_have_coordinates(write, load):
    write("a.png", painted(GREEN))
    write("a.mtl", "newmtl m\nKd 1 0 0\nmap_Kd a.png\n")
    faces = "vt 0 0\nvt 1 1\nf 1/1 2/2 3/2\nf 1/1 2/2 3\nf 1 2 3\n"
    mesh, (said,) = load(write("a.obj", f"mtllib a.mtl\n{POINTS}{faces}"))
    assert "lack texture coordinates; they are shown in its plain colour" in said
    assert textures(mesh) == [GREEN, WHITE, WHITE]
    assert first_corners(mesh) == [WHITE, RED, RED]


def test_weights_of_vertices_divide(write):
    path = write("a.obj", "v 0 0 0 1\nv 2 0 0 2\nv 0 3 0\nv 0 0 4 0\nf 1 2 3\nf 1 2 4\n")
    mesh = cr.load_mesh(path)
    assert mesh.bounds.tolist() == [[0, 0, 0], [1, 3, 4]]


# PLY

TEXTURES = "".join(f"comment TextureFile {name}.png\n" for name in ("red", "green"))


def test_the_texture_of_a_polygon_is_that_of_its_triangles(write):
    for name, colour in (("red", RED), ("green", GREEN)):
        write(f"{name}.png", painted(colour))
    text = header(UV, "property int texnumber\n", count=4, comments=TEXTURES)
    faces = "4 0 1 2 3 1\n3 0 1 2 0\n3 0 1 3 -1\n3 0 2 3 -2\n"
    mesh = cr.load_mesh(write("a.ply", text + rows(["0 0"] * 4) + faces))
    assert textures(mesh) == [GREEN, GREEN, RED, WHITE, WHITE]


def test_colours_of_faces_win_over_those_of_vertices(write):
    text = header(RGB, RGB) + rows(["255 0 0"] * 4) + "3 0 1 2 0 0 255\n3 0 2 3 0 255 0\n"
    assert first_corners(cr.load_mesh(write("a.ply", text))) == [BLUE, GREEN]


# 3MF


def test_the_model_in_its_usual_place_is_the_first(read_3mf):
    others = dict.fromkeys(("a.model", "3D/a.model", "3D/very/3dmodel_b.model"), "<model/>")
    assert len(read_3mf(solid(1), more=others)[0].faces) == 12


# URDF


def wedge(folder):
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], [[0, 1, 2], [0, 1, 3]]).export(
        folder / "wedge.stl"
    )
    return mesh_of_robot("wedge.stl", 'scale="1 2 1"')


def test_roll_comes_before_pitch_before_yaw(tmp_path, read_urdf):
    half = math.pi / 2
    origin = f'<origin rpy="{half} 0 {half}" xyz="10 0 0"/>'
    mesh = read_urdf(wedge(tmp_path) + origin)
    # roll takes y to z and z to -y, yaw x to y and y to -x: (1, 4, 3) -> (3, 1, 4)
    assert_allclose(mesh.bounds, [[10, 0, 0], [13, 1, 4]], atol=1e-6)
    origin = f'<origin rpy="0 {half} {half}"/>'
    mesh = read_urdf(wedge(tmp_path) + origin)
    # pitch takes x to -z and z to x
    assert_allclose(mesh.bounds, [[-4, 0, -1], [0, 3, 0]], atol=1e-6)


def test_a_visual_lies_in_its_link_and_that_at_its_joint(tmp_path, read_urdf):
    joint = '<link name="base"/><joint name="j" type="fixed"><parent link="base"/>'
    joint += f'<child link="tip"/><origin rpy="0 0 {math.pi / 2}" xyz="0 0 5"/></joint>'
    visual = wedge(tmp_path) + '<origin xyz="10 0 0"/>'
    mesh = read_urdf(visual, more=joint)
    assert_allclose(mesh.bounds, [[-4, 10, 5], [0, 11, 8]], atol=1e-6)


def test_a_colour_of_a_visual_wins_over_a_named_one(read_urdf):
    named = '<material name="m"><color rgba="1 0 0 1"/></material>'
    own = '<material name="m"><color rgba="0 0 1 1"/></material>'
    box = '<geometry><box size="1 1 1"/></geometry>'
    assert first_corners(read_urdf(box + own, more=named))[0] == BLUE
    bare = '<material name="m"/>'
    assert first_corners(read_urdf(box + bare, more=named))[0] == RED


def test_colours_of_a_mesh_win_over_those_of_the_urdf(write, read_urdf):
    write("a.ply", header(RGB) + rows(["0 255 0"] * 4) + FACES)
    own = '<material name="m"><color rgba="0 0 1 1"/></material>'
    assert first_corners(read_urdf(mesh_of_robot("a.ply") + own)) == [GREEN, GREEN]


# USD


@needs_usd
def test_helpers_and_holes_are_no_surface(read_usd):
    for purpose, faces in (("guide", 2), ("proxy", 2), ("render", 4), ("default", 4)):
        other = square(f'uniform token purpose = "{purpose}"').replace('"square"', '"other"')
        assert len(read_usd(square(), other)[0].faces) == faces
    holed = square("int[] holeIndices = [0]", counts="3, 3", indices="0, 1, 2, 0, 2, 3")
    mesh, _ = read_usd(holed)
    assert mesh.surface.triangles.tolist() == [[[0, 0, 0], [2, 1, 0], [0, 1, 0]]]


@needs_usd
def test_materials_of_usd_win_over_colours_of_the_mesh(tmp_path, read_usd):
    write_print(tmp_path, painted(RED))
    colour = 'color3f[] primvars:displayColor = [(0, 1, 0)] (interpolation = "constant")\n        '
    plain = square(colour).replace('"square"', '"plain"')
    mesh, _ = read_usd(MATERIAL, square(colour + MAP, BOUND), plain)
    assert first_corners(mesh) == [WHITE, WHITE, GREEN, GREEN]
    assert textures(mesh) == [RED, RED, WHITE, WHITE]


# Faces and colours of all formats


def test_a_mirrored_part_keeps_its_outside_and_its_colours():
    colours = SurfaceColours.plain(1)
    colours.corners[0] = [RED, GREEN, BLUE]
    colours.uv[0] = [[0, 0], [1, 0], [0, 1]]
    mesh = ReadMesh(np.array(TRIANGLE), np.array([[0, 1, 2]]), colours, "mm", "y")
    for signs, order in (((-1, 1, 1), [2, 1, 0]), ((-1, -1, 1), [0, 1, 2])):
        moved = mesh.transformed(np.diag([*signs, 1.0]))
        assert moved.vertices.tolist() == (mesh.vertices * signs).tolist()
        assert moved.faces.tolist() == [order]
        for name in ("corners", "uv"):
            found = getattr(moved.colours, name)[0]
            np.testing.assert_array_equal(found, getattr(colours, name)[0, order])
        assert (moved.unit, moved.up) == ("mm", "y")


def test_transparent_texels_are_white():
    file = BytesIO()
    Image.new("RGBA", (2, 2), (200, 0, 0, 51)).save(file, "PNG")
    pixels, count = texture_pixels(file.getvalue(), 4)
    assert (pixels[0, 0].tolist(), count) == ([244, 204, 204], 4)


COLOURS = """
[0.0, 0.5, 1.0]      | [0, 128, 255]
[0.2, 0.5, 1.0024]   | [51, 128, 255]
[0.2, 0.5, Infinity] | [51, 128, 255]
[0.2, 0.5, NaN]      | [51, 128, 0]
[0.0, 1.0, 1.0]      | [0, 255, 255]
[0.0, 1.0, 2.0]      | [0, 1, 2]
[0.0, 51.5, 254.9]   | [0, 52, 255]
[0.5, 20.5, 300.0]   | [0, 20, 255]
[-1.0, 0.5, 0.5]     | [0, 128, 128]
[0.0, 0.0, 0.0]      | [0, 0, 0]
"""


@pytest.mark.parametrize(("values", "expected"), text_table(COLOURS))
def test_colours_are_fractions_or_bytes(values, expected):
    assert colour_bytes(np.array(values)).tolist() == expected


def test_a_bright_channel_and_an_uncoloured_vertex_leave_the_others_alone(write):
    text = "v 0 0 0 1.0024 0.2 0\nv 1 0 0 0 0.2 0\nv 0 1 0 1 0.2 0\nv 5 5 5\nf 1 2 3\nf 4 1 2\n"
    mesh = cr.load_mesh(write("a.obj", text))
    assert first_corners(mesh) == [[255, 51, 0], WHITE]


def test_a_folder_beside_the_mesh_wins_over_one_of_textures(write):
    beside = write("mesh/a.png", b"mesh")
    other = write("textures/a.png", b"textures")
    source = MeshSource(beside.with_name("a.obj"), [other.parent])
    assert source.read("a.png") == b"mesh"
    beside.unlink()
    assert source.read("a.png") == b"textures"
    assert source.read("somewhere/else/a.png") == b"textures"


def test_names_do_not_lead_out_of_a_folder_of_textures(tmp_path, write):
    for folder in ("mesh", "textures"):
        (tmp_path / folder).mkdir()
    (tmp_path / "textures" / "link.png").symlink_to(write("secret.png", b"secret"))
    source = MeshSource(tmp_path / "mesh" / "a.obj", [tmp_path / "textures"])
    for name in ("../secret.png", "link.png", "../mesh/../secret.png"):
        assert not source.has(name)
        assert source.read_optional("texture", name) is None


def test_a_mesh_of_a_robot_may_use_files_of_the_robots_folder(tmp_path, write):
    library = write("a.mtl", "newmtl red")
    robot = MeshSource(tmp_path / "a.urdf")
    part = robot.beside(write("meshes/a.obj", ""))
    assert part.read("a.mtl") == b"newmtl red"
    assert robot.requested == {library}


def test_of_a_kind_of_warning_a_few_are_kept(tmp_path):
    source = MeshSource(tmp_path / "a.obj")
    for k in range(8):
        source.warn("texture", f"{k} is missing")
        source.warn("texture", "0 is missing")
    texts = [warning.text for warning in source.warnings]
    assert texts == [*(f"{k} is missing" for k in range(5)), "and more of this kind"]


def test_parts_of_a_robot_are_in_metres_whatever_their_own_unit(tmp_path, read_urdf):
    threemf(tmp_path / "a.3mf", solid(1), unit='unit="millimeter"')
    mesh = read_urdf(mesh_of_robot("a.3mf"))
    assert mesh.unit == "m"
    assert_allclose(mesh.extents, [0.03, 0.02, 0.01])


def test_colours_of_a_material_in_memory():
    """Of one that states none, trimesh makes a grey, which is no colour of the mesh. Factors of
    glTF are linear: 51 is 124 of sRGB."""
    for material, expected in (
        (trimesh.visual.material.SimpleMaterial(diffuse=[10, 20, 30, 255]), [10, 20, 30]),
        (trimesh.visual.material.SimpleMaterial(), None),
        (trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 51, 0, 255]), [255, 124, 0]),
    ):
        mesh = trimesh.Trimesh(TRIANGLE, [[0, 1, 2]], process=False)
        mesh.visual = trimesh.visual.TextureVisuals(uv=np.zeros((3, 2)), material=material)
        (colours,) = colours_of_parts([mesh])
        found = None if colours is None else colours.corners[0, 0].tolist()
        assert found == expected


def test_objects_of_one_number_in_two_models_are_no_copies(read_3mf):
    move = 'transform="1 0 0 0 1 0 0 0 1 100 0 0"'
    items = f'<item objectid="1"/><item objectid="1" p:path="/3D/b.model" {move}/>'
    mesh, _ = read_3mf(solid(1), items, more={"3D/b.model": model(solid(1), "")})
    assert mesh.bounds[:, 0].tolist() == [-15, 115]
