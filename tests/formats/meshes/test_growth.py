"""Small files cannot make a reader work or hold much: what grows, and with what, is counted."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh

import curvireg_torch as cr
from curvireg_torch.errors import MeshError
from curvireg_torch.formats import xml_files
from curvireg_torch.formats.meshes import cad, colours, files, gltf, limits, source, threemf, usd
from curvireg_torch.formats.meshes.source import MeshSource, ReadMesh, is_file_name
from curvireg_torch.formats.xml_files import read_xml
from curvireg_torch.utils import programs
from curvireg_torch.utils.extras import is_installed
from curvireg_torch.utils.programs import run_program
from tests._support.refusals import refused
from tests._support.spies import spied
from tests.formats.meshes.packages import mesh_of_robot, robot, solid
from tests.formats.meshes.packages import threemf as write_package
from tests.formats.meshes.pictures import painted
from tests.formats.meshes.test_cad import collada
from tests.formats.meshes.test_gltf import skinned, textured

UNUSED = 10_000  # vertices
PICTURE = painted((200, 100, 50))


def resolved(monkeypatch, path):
    """How many paths are resolved while a mesh is read."""
    with monkeypatch.context() as patch:
        calls = spied(patch, Path, "resolve")
        files.read_source(MeshSource(path))
    return len(calls)


def peak(path):
    """The most bytes that are held while a mesh is read."""
    tracemalloc.start()
    files.read_source(MeshSource(path))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most


def test_names_of_urdf_are_looked_for_by_a_bounded_number_of_ends(tmp_path, monkeypatch, bounded):
    counts = []
    for parts in (10, 20, 1000, 2000):
        mesh = mesh_of_robot(f"package://{'a/' * parts}b.stl")
        box = '<geometry><box size="1 1 1"/></geometry>'
        path = robot(tmp_path / "a.urdf", box, mesh, mesh)
        counts.append(resolved(monkeypatch, path))
    few, twice, many, most = counts
    assert many == most < few < twice <= 2 * few
    assert twice < 30
    visuals = [mesh_of_robot(f"package://{k}/b.stl") for k in range(60)]
    path = robot(tmp_path / "a.urdf", *visuals)
    bounded(path, "more than 50 parts", limits, "MAX_MESH_PARTS", 50)


def with_unused_vertices():
    box = trimesh.creation.box()
    vertices = np.concatenate([np.zeros((UNUSED, 3)), box.vertices])
    return ReadMesh(vertices, np.asarray(box.faces, np.int64) + UNUSED)


def test_unused_vertices_are_dropped():
    mesh = with_unused_vertices()
    small = mesh.without_unused_vertices()
    assert small.vertices.shape == (8, 3)
    np.testing.assert_array_equal(small.vertices[small.faces], mesh.vertices[mesh.faces])
    assert small.without_unused_vertices() is small
    with refused("a vertex that the file lacks", ValueError):
        ReadMesh(np.zeros((3, 3)), np.array([[0, 1, -1]])).without_unused_vertices()


@pytest.mark.parametrize("suffix", ["urdf", "3mf"])
def test_copies_of_a_part_do_not_hold_its_unused_vertices(tmp_path, suffix):
    mesh = with_unused_vertices()
    ply = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    ply.export(tmp_path / "a.ply")
    copy = '<component objectid="1" transform="1 0 0 0 1 0 0 0 1 0 0 {}"/>'
    peaks = []
    for copies in (4, 16):
        if suffix == "urdf":
            path = robot(tmp_path / "a.urdf", *[mesh_of_robot("a.ply")] * copies)
        else:
            all_copies = "".join(map(copy.format, range(copies)))
            whole = f'<object id="2"><components>{all_copies}</components></object>'
            resources = solid(1, shape=mesh) + whole
            path = write_package(tmp_path / "a.3mf", resources, '<item objectid="2"/>')
        peaks.append(peak(path))
    assert peaks[1] - peaks[0] < UNUSED  # bytes: less than one for each vertex


def test_an_image_of_many_parts_is_read_and_decoded_once(loaded, monkeypatch):
    """From a text, and from a view as in GLB."""
    tree = textured({})
    (part,) = tree.content["meshes"][0]["primitives"]
    materials = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(20)]
    tree.content |= {
        "meshes": [{"primitives": [{**part, "material": k} for k in range(20)]}],
        "materials": materials,
        "textures": [{"source": 0}] * 20,
    }
    view = tree.array(np.frombuffer(PICTURE, np.uint8), "B")
    for image, texts, views in ((*tree.content["images"], 2, 0), ({"bufferView": view}, 1, 1)):
        tree.content["images"] = [image]
        with monkeypatch.context() as patch:
            of_texts = spied(patch, gltf, "_data_of")  # of the buffer too
            of_views = spied(patch, gltf._File, "_view")
            decoded = spied(patch, colours, "_texture")
            found = loaded(tree).colours
        assert (len(found), len(found.textures), len(decoded)) == (20, 1, 1)
        assert (len(of_texts), [index for _, index in of_views].count(view)) == (texts, views)


def test_joints_of_a_skin_are_placed_once(tmp_path, monkeypatch):
    joints = spied(monkeypatch, gltf._File, "_joints")
    placed = spied(monkeypatch, gltf.np, "stack")
    whole = skinned([0] * 4, [1, 0, 0, 0], {"translation": [0, 0, 2]})
    whole.content["nodes"] += [{"mesh": 0, "skin": 0}] * 19
    whole.content["scenes"] = [{"nodes": list(range(21))}]
    monkeypatch.setattr(gltf, "SKINNED_AT_ONCE", 2)  # blocks of one part
    found = files.read_source(MeshSource(whole.write(tmp_path / "a.gltf")))
    assert (found.vertices[:, 2] == 2.0).all()
    assert found.vertices[:3].tolist() == [[0, 0, 2], [1, 0, 2], [0, 1, 2]]
    assert (len(joints), len(placed)) == (20, 1)
    whole.content["skins"] = [{"joints": [1] * 100_001}]
    with refused("more than 100,000 joints", MeshError):
        cr.load_mesh(whole.write(tmp_path / "a.gltf"))


def test_names_outside_of_the_folder_are_counted(tmp_path, monkeypatch, bounded):
    path = tmp_path / "a.obj"
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    counts = []
    for count in (100, 200):
        names = " ".join(f"../{k}.mtl" for k in range(count))
        path.write_text(f"mtllib {names}\n{triangle}")
        counts.append(resolved(monkeypatch, path))
    assert counts[1] - counts[0] <= 100
    bounded(path, "names more than 199 files", source, "MAX_MESH_PARTS", 199)


POSSIBLE = ["a.png", "textures/" * 63 + "a.png", "a" * 255, "/".join(["a" * 200] * 20)]
IMPOSSIBLE = ["textures/" * 64 + "a.png", "t\\" * 64 + "a.png", "a" * 256, "ä" * 128]
IMPOSSIBLE += ["/".join(["a" * 200] * 21), "a\0b", " ", "\ud800.png"]


@pytest.mark.parametrize("name", POSSIBLE + IMPOSSIBLE)
def test_names_that_no_file_has(name):
    assert is_file_name(name) == (name in POSSIBLE)


def test_a_long_name_of_a_texture_leaves_the_mesh_alone(tmp_path, write, load):
    write("a.mtl", f"newmtl m\nKd 1 0 0\nmap_Kd {'x' * 8000}.png\n")
    write("a.obj", "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    mesh, texts = load(tmp_path / "a.obj")
    assert len(mesh.faces) == 1
    assert texts == [
        f"{tmp_path / 'a.obj'}: {'x' * 100} is no name of a file, and is left out",
    ]


def test_a_texture_of_many_groups_is_unpacked_once(tmp_path, monkeypatch):
    groups = "".join(
        f'<texture2dgroup id="{k}" texid="7"><tex2coord u="0" v="0"/></texture2dgroup>'
        for k in range(10, 20)
    )
    faces = "".join(f'<triangle v1="0" v2="1" v3="2" pid="{k}" p1="0"/>' for k in range(10, 20))
    vertices = '<vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/>'
    mesh = f"<mesh><vertices>{vertices}</vertices><triangles>{faces}</triangles></mesh>"
    resources = f'<texture2d id="7" path="/3D/a.png"/>{groups}<object id="1">{mesh}</object>'
    path = write_package(tmp_path / "a.3mf", resources, more={"3D/a.png": PICTURE})
    asked = spied(monkeypatch, threemf._Package, "_content")
    found = files.read_source(MeshSource(path)).colours
    assert len(found.textures) == 1
    assert [name for _, name in asked].count("/3D/a.png") == 1
    monkeypatch.setitem(threemf._MOST, "triangle", 9)
    with refused("more than 9 of 'triangle'", MeshError):
        cr.load_mesh(path)


@pytest.mark.skipif(not is_installed("collada"), reason="collada is not installed")
def test_collada_counts_faces_of_copies_and_decodes_a_picture_once(
    tmp_path, write, monkeypatch, bounded
):
    write("label.png", PICTURE)
    path = tmp_path / "a.dae"
    text = collada()
    materials = "".join(
        f'<material id="m{k}"><instance_effect url="#fx"/></material>' for k in range(5)
    )
    path.write_text(text.replace("</library_materials>", f"{materials}</library_materials>"))
    decoded = spied(monkeypatch, source, "texture_pixels")
    files.read_source(MeshSource(path))
    assert len(decoded) == 1
    copies = '<instance_geometry url="#g"/>' * 4
    skin = '<controller id="c"><skin source="#g"/></controller>'
    for more in (copies, '<instance_controller url="#c"/>' * 4):
        with_more = collada(more=more).replace("<library_nodes>", f"{skin}<library_nodes>")
        path.write_text(with_more)
        bounded(path, "more than 4 faces", limits, "MAX_MESH_FACES", 4)
        monkeypatch.setattr(limits, "MAX_MESH_FACES", 5)
        cad._check_copies(read_xml(with_more.encode()))
    bounded(path, "more than 20 elements of XML", xml_files, "MAX_XML_ELEMENTS", 20)


def test_a_program_has_limits_of_time_and_memory(tmp_path, monkeypatch):
    program = tmp_path / "program.py"
    words = {"name": "It", "advice": "export less"}
    monkeypatch.setattr(programs, "MAX_CAD_SECONDS", 60.0)
    monkeypatch.setattr(programs, "MAX_CAD_MEMORY", 1 << 28)
    program.write_text("import sys\nsys.exit(int(sys.argv[1]))")
    assert run_program(program, ["0"], **words)
    assert not run_program(program, ["1"], **words)
    program.write_text("x = bytearray(1 << 29)")
    with refused(r"It needs more than 268,435,456 bytes .*; export less", ValueError):
        run_program(program, [], **words)
    program.write_text("while True:\n    pass")
    monkeypatch.setattr(programs, "MAX_CAD_SECONDS", 0.2)
    with refused(r"It took more than 0.2 seconds; export less", ValueError):
        run_program(program, [], **words)


@pytest.mark.skipif(not is_installed("pxr"), reason="usd-core is not installed")
def test_usd_drops_unused_points_before_they_are_copied(write):
    points = ", ".join(["(9, 9, 9)"] * 1000 + ["(0, 0, 0)", "(1, 0, 0)", "(0, 1, 0)"])
    text = f"""#usda 1.0
def Xform "a" (
    instanceable = true
)
{{
    def Mesh "m"
    {{
        point3f[] points = [{points}]
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [1000, 1001, 1002]
    }}
}}
def "b" (
    instanceable = true
    references = </a>
)
{{
}}
"""
    _, arrays = usd._parts_of(write("a.usda", text))
    for key in ("0.", "1."):
        assert arrays[key + "points"].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
        assert arrays[key + "indices"].tolist() == [0, 1, 2]
