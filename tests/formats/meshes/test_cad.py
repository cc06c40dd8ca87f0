"""STEP, IGES, Collada, 3MF and URDF files, which are generated."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

import curvireg_torch as cr
from curvireg_torch.errors import MeshError, MissingDependencyError
from curvireg_torch.formats.meshes import cad, limits
from curvireg_torch.formats.meshes import threemf as reader
from curvireg_torch.formats.meshes.files import mesh_files
from curvireg_torch.utils import extras, programs
from curvireg_torch.utils.extras import is_installed
from tests._support.quick import slow_after
from tests._support.refusals import refused
from tests._support.tables import text_table
from tests.formats.meshes.packages import (
    BOX,
    ITEM,
    SMALL,
    mesh_of_robot,
    model,
    robot,
    solid,
    threemf,
)
from tests.formats.meshes.pictures import encoded, noise
from tests.formats.meshes.step import global_section, iges_file, step_file


def needs(package):
    return pytest.mark.skipif(not is_installed(package), reason=f"{package} is not installed")


@needs("cascadio")
@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(("unit", "suffix"), [("cm", "step"), ("in", "STP")])
def test_step_files_keep_their_unit_and_axes(write, unit, suffix):
    mesh = cr.load_mesh(write(f"part.{suffix}", step_file((3.0, 2.0, 1.0), unit)))
    assert (mesh.unit, mesh.up) == (unit, "z")
    assert_allclose(mesh.bounds, [[0, 0, 0], [3, 2, 1]], atol=1e-6)
    assert mesh.surface.volume == pytest.approx(6.0, rel=1e-6)


@needs("cascadio")
@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(("flag", "name", "unit"), [(2, "MM", "mm"), (1, "IN", "in")])
def test_iges_files_keep_their_unit(write, load, flag, name, unit):
    mesh, _ = load(write("part.igs", iges_file((3.0, 2.0), flag, name)))
    assert mesh.unit == unit
    assert_allclose(mesh.bounds, [[0, 0, 0], [3, 2, 0]], atol=1e-5)


@needs("cascadio")
@pytest.mark.parametrize(
    "content",
    slow_after(
        2,
        [
            step_file((3, 2, 1), "mm").encode()[:900],
            b"",
            b"ISO-10303-21;\n",
            b"nothing",
            b"ISO-10303-21;" * 999,
        ],
    ),
)
def test_damaged_step_files_are_refused(refused, content):
    refused("part.step", content, r"part\.step: cannot be read as a mesh")


@needs("cascadio")
def test_step_files_are_bounded_in_size_and_time(write, bounded):
    path = write("part.step", step_file((3.0, 2.0, 1.0), "mm"))
    bounded(path, "larger than 99 bytes", cad, "MAX_CAD_BYTES", 99)
    bounded(path, "more than 99 bytes", cad, "MAX_MESH_BYTES", 99)
    bounded(path, "took more than 0.001 seconds", programs, "MAX_CAD_SECONDS", 0.001)


@pytest.mark.parametrize(
    ("suffix", "package", "extra"),
    [
        *((suffix, "cascadio", "cad") for suffix in ["step", "stp", "iges", "igs"]),
        ("dae", "collada", "cad"),
        *((suffix, "pxr", "usd") for suffix in ["usd", "usda", "usdc", "usdz"]),
    ],
)
def test_the_message_names_the_extra(write, monkeypatch, suffix, package, extra):
    monkeypatch.setattr(extras, "find_spec", lambda _: None)
    with refused(package, MissingDependencyError) as caught:
        cr.load_mesh(write(f"a.{suffix}", "a part"))
    text = str(caught.value)
    assert f"pip install 'curvireg_torch[{extra}]'" in text
    assert f"in a checkout pip install -e '.[{extra}]'" in text
    assert text.count(f"a.{suffix}") == 1


@pytest.mark.slow
def test_the_extra_is_loaded_only_when_needed(tmp_path):
    BOX.export(tmp_path / "a.stl")
    code = "import sys, curvireg_torch as cr; cr.load_mesh(sys.argv[1], unit='mm'); "
    code += "print('collada' in sys.modules)"  # trimesh itself imports cascadio
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a.stl"], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False"


IGES = """
1H,,1H;,4Hpart,8Hpart.igs,3Hcad,3H1.0,32,38,6,308,15,4Hpart,1.,2,2HMM,1,0.01,15H20260101.000000, | mm
1H,,1H;,4Hpart,8Hpa,t.igs,3Hcad,3H1.0,32,38,6,308,15,,1.,1,4HINCH,1,0.01,                        | in
,,4Hpart,8Hpart.igs,3Hcad,3H1.0,32,38,6,308,15,,1.,6,1HM,1,                                      | m
1H/,1H;,4Hpart/8Hpart.igs/3Hcad/3H1.0/32/38/6/308/15//1./10/2HCM/                                | cm
1H,,1H;,4Hpart,8Hpart.igs,3Hcad,3H1.0,32,38,6,308,15,,1.,9,2HUM,                                 | null
                                                                                                 | null
9999H                                                                                            | null
"""  # noqa: E501


@pytest.mark.parametrize(("parameters", "unit"), text_table(IGES))
def test_the_unit_of_an_iges_file(parameters, unit):
    lines = [f"{'part':<72}S      1", *global_section(parameters)]
    assert cad.iges_unit("\n".join(lines).encode()) == unit


@pytest.mark.parametrize("prefix", [".MILLI.", ".MICRO.", "$"])
def test_the_unit_of_a_step_file_is_that_of_its_context(prefix):
    """The base of a converted unit is none itself."""
    text = step_file((3.0, 2.0, 1.0), "in")
    assert cad.step_unit(text.encode()) == "in"
    text = step_file((3.0, 2.0, 1.0), "mm").replace(".MILLI.", prefix)
    assert cad.step_unit(text.encode()) == {".MILLI.": "mm", "$": "m"}.get(prefix)
    assert cad.step_unit(b"") is None


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>{asset}</asset>
<library_images><image id="im"><init_from>{image}</init_from></image></library_images>
<library_effects><effect id="fx"><profile_COMMON>
<newparam sid="surf"><surface type="2D"><init_from>im</init_from></surface></newparam>
<newparam sid="samp"><sampler2D><source>surf</source></sampler2D></newparam>
<technique sid="t"><lambert><diffuse><texture texture="samp" texcoord="UV"/></diffuse></lambert></technique>
</profile_COMMON></effect></library_effects>
<library_materials><material id="mat"><instance_effect url="#fx"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="9">0 0 0 4 0 0 0 2 0</float_array><technique_common>
<accessor source="#pa" count="3" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<source id="u"><float_array id="ua" count="6">0 0 1 0 0 1</float_array><technique_common>
<accessor source="#ua" count="3" stride="2"><param name="S" type="float"/><param name="T" type="float"/></accessor>
</technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="1" material="m"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="TEXCOORD" source="#u" offset="1"/><p>0 0 1 1 2 2</p></triangles></mesh></geometry></library_geometries>
<library_nodes>{nodes}</library_nodes>
<library_visual_scenes><visual_scene id="s"><node><translate>10 0 0</translate><instance_geometry url="#g">
<bind_material><technique_common><instance_material symbol="m" target="#mat"/></technique_common></bind_material>
</instance_geometry>{more}</node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""  # noqa: E501


def collada(asset="", image="label.png", nodes="", more=""):
    return COLLADA.format(asset=asset, image=image, nodes=nodes, more=more)


ASSETS = """
<unit name="inch" meter="0.0254"/><up_axis>Z_UP</up_axis> | in | z | 1.0
<unit meter="0.001"/>                                     | mm | y | 1.0
<unit meter="0.05"/><up_axis>X_UP</up_axis>               | m  | x | 0.05
                                                          | m  | y | 1.0
"""


@needs("collada")
@pytest.mark.parametrize(("asset", "unit", "up", "scale"), text_table(ASSETS))
def test_collada_files_keep_their_unit_and_axes(write, load, asset, unit, up, scale):
    picture = write("label.png", encoded(noise()))
    path = write("a.dae", collada(asset))
    mesh, texts = load(path)
    assert (mesh.unit, mesh.up, texts) == (unit, up, [])
    assert_allclose(mesh.bounds, np.array([[10, 0, 0], [14, 2, 0]]) * scale, atol=1e-6)
    colours = mesh.colours
    np.testing.assert_array_equal(colours.textures[0], noise())
    assert_allclose(colours.uv[0], [[0, 0], [1, 0], [0, 1]], atol=1e-6)
    assert picture in mesh_files(path)


@needs("collada")
def test_collada_names_textures_that_it_cannot_use(write, load):
    write("label.png", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    for image, match in (
        ("no.png", "no.png is missing"),
        ("../x.png", "lies outside"),
        ("label.png", "not an image"),
    ):
        mesh, texts = load(write("a.dae", collada(image=image)))
        assert not mesh.has_colours
        assert match in " ".join(texts)


@pytest.mark.parametrize("first", range(8))
def test_gaps_of_a_polygon_are_found_from_each_corner(first):
    """A fan of these corners has triangles without area."""
    outline = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)]
    corners = np.pad(np.roll(outline, -first, axis=0), ((0, 0), (0, 1))).astype(float)
    fan = [(0, k, k + 1) for k in range(1, 7)]
    assert cad._has_filled_gaps(trimesh.Trimesh(corners, fan, process=False))
    square = trimesh.Trimesh(corners, process=False, faces=np.zeros((0, 3), int))
    assert not cad._has_filled_gaps(square)


@needs("collada")
def test_collada_names_polygons_and_transforms_that_it_misreads(write, load):
    write("label.png", encoded(noise()))
    start, _, rest = collada().partition("<triangles")
    start = start.replace('count="9">0 0 0 4 0 0 0 2 0<', 'count="12">0 0 0 4 0 0 0 2 0 1 .5 0<')
    start = start.replace('count="3" stride="3"', 'count="4" stride="3"')
    end = rest.partition("</triangles>")[2]

    def said(kind, content, end=end):
        inputs = '<input semantic="VERTEX" source="#v" offset="0"/>'
        primitive = f'<{kind} count="1">{inputs}{content}</{kind}>'
        return "".join(load(write("a.dae", start + primitive + end))[1])

    assert said("polylist", "<vcount>4</vcount><p>0 1 3 2</p>") == ""
    assert said("polylist", "<vcount>3 3</vcount><p>0 1 2 0 2 1</p>") == ""
    assert "whose gaps are filled" in said("polylist", "<vcount>4</vcount><p>1 3 2 0</p>")
    hole = "<p>0 1 2</p><ph><p>0 1 2</p><h>0 3 1</h></ph>"
    assert "elements <ph> are misread" in said("polygons", hole)
    skewed = end.replace("<translate>", "<skew>45 0 1 0 1 0 0</skew><translate>")
    assert "elements <skew> are misread" in said("polygons", "<p>0 1 2</p>", skewed)


@needs("collada")
def test_hostile_collada_files_are_refused(refused):
    nodes = "".join(
        f'<node id="n{k}">' + f'<instance_node url="#n{k + 1}"/>' * 10 + "</node>"
        for k in range(20)
    )
    nodes += '<node id="n20"><instance_geometry url="#g"/></node>'
    circle = '<node id="n0"><instance_node url="#n0"/></node>'
    more = '<instance_node url="#n0"/>'
    entity = collada().replace("<COLLADA", '<!DOCTYPE x [<!ENTITY a "aaaa">]>\n<COLLADA', 1)
    wide = entity.replace('version="1.0"', 'version="1.0" encoding="utf-16"').encode("utf-16")
    for content, match in (
        (collada(nodes=nodes, more=more), "more than 10,000 parts"),
        (collada(nodes=circle, more=more), "form a circle"),
        (entity, "document type"),
        (wide, "document type"),
        ("<COLLADA>", "cannot be read"),
        ("", "cannot be read"),
    ):
        refused("a.dae", content, match)


def test_threemf_names_shapes_that_are_left_out(tmp_path, read_3mf):
    lattice = "<b:beamlattice><b:beams/></b:beamlattice></mesh>"
    resources = solid(1).replace("</mesh>", lattice).replace("<object", '<object xmlns:b="beams"')
    mesh, texts = read_3mf(resources)
    assert len(mesh.faces) == 12
    assert texts == [
        f"{tmp_path / 'a.3mf'}: it has parts that are not read (beamlattice): left out"
    ]


def test_threemf_places_objects_and_their_components(tmp_path, read_3mf):
    components = (
        '<component objectid="1" transform="0 1 0 -1 0 0 0 0 1 100 0 0"/><component objectid="1"/>'
    )
    resources = solid(1) + f'<object id="2"><components>{components}</components></object>'
    items = '<item objectid="2" transform="1 0 0 0 0 1 0 -1 0 0 0 5"/>'
    mesh, texts = read_3mf(resources, items)
    assert (mesh.unit, mesh.up, len(mesh.faces), texts) == ("in", "z", 24, [])
    assert_allclose(mesh.bounds, [[-15, -5, -10], [110, 5, 20]])
    assert mesh.surface.volume == pytest.approx(2 * 6000)
    assert cr.load_mesh(tmp_path / "a.3mf", up="-y").up == "-y", "what is given comes first"
    with refused("the file states its unit, in, which is not 'mm'; leave the unit out", MeshError):
        cr.load_mesh(tmp_path / "a.3mf", unit="mm")
    for unit, name, scale in (
        ("", "mm", 1.0),
        ('unit="micron"', "mm", 1e-3),
        ('unit="meter"', "m", 1.0),
    ):
        mesh, _ = read_3mf(solid(1), unit=unit)
        assert (mesh.unit, mesh.extents[0]) == (name, pytest.approx(30.0 * scale))


def test_threemf_leaves_out_what_is_not_the_object(read_3mf):
    """Supports, items that are not printed, and copies on the build plate."""
    resources = solid(1) + solid(2).replace('type="model"', 'type="support"')
    resources += solid(3).replace('type="model"', 'type="solidsupport"') + solid(4)
    move = 'transform="1 0 0 0 1 0 0 0 1 {} 0 0"'
    items = f'<item objectid="1" {move.format(50)}/>'
    more = "".join(f'<item objectid="{k}" {move.format(500)}/>' for k in (1, 2, 3))
    mesh, texts = read_3mf(resources, items + more)
    assert mesh.bounds[:, 0].tolist() == [35, 65]
    assert [text.partition(": ")[2] for text in texts] == [
        "supports of the print are left out",
        "further copies of its objects on the build plate are left out (1)",
    ]
    for flag in ("0", "false"):
        mesh, texts = read_3mf(resources, items + f'<item objectid="4" printable="{flag}"/>')
        assert len(mesh.faces) == 12
        assert "items that are not printed" in texts[0]
    mesh, texts = read_3mf(resources, items + '<item objectid="4" printable="1"/>')
    assert len(mesh.faces) == 24
    assert "2 objects on its build plate are read as one rigid body" in texts[0]


def test_threemf_leaves_out_modifiers_of_slicers(read_3mf):
    """By the type of their object; by the settings of Bambu Studio; by those of PrusaSlicer."""
    said = "parts that change the print, such as modifiers and negative parts, are left out"
    parts = '<component objectid="1"/><component objectid="2"/>'
    whole = f'<object id="3"><components>{parts}</components></object>'
    other = solid(2, shape=SMALL).replace('type="model"', 'type="other"')
    bambu = (
        '<config><object id="3"><part id="1" subtype="normal_part"/>'
        '<part id="2" subtype="negative_part"/></object></config>'
    )
    joined = solid(1, shape=trimesh.util.concatenate([SMALL, BOX]))
    prusa = (
        '<config><object id="1"><volume firstid="0" lastid="11"><metadata type="volume" '
        'key="{}" value="{}"/></volume><volume firstid="12" lastid="23"><metadata type="volume" '
        'key="volume_type" value="ModelPart"/></volume></object></config>'
    )
    for resources, number, settings in (
        (solid(1) + other + whole, 3, {}),
        (solid(1) + solid(2, shape=SMALL) + whole, 3, {"model_settings.config": bambu}),
        *(
            (joined, 1, {"Slic3r_PE_model.config": prusa.format(key, value)})
            for key, value in (("volume_type", "SupportBlocker"), ("modifier", "1"))
        ),
    ):
        more = {f"Metadata/{name}": content for name, content in settings.items()}
        mesh, texts = read_3mf(resources, f'<item objectid="{number}"/>', more=more)
        assert (len(mesh.faces), mesh.extents.tolist()) == (12, [30.0, 20.0, 10.0])
        assert [text.partition(": ")[2] for text in texts] == [said]
    more = {"Metadata/Slic3r_PE_model.config": "<config>"}
    mesh, (text,) = read_3mf(solid(1), '<item objectid="1"/>', more=more)
    assert len(mesh.faces) == 12
    assert "config cannot be read: modifiers in it count as parts" in text


def test_threemf_reads_colours_and_textures(read_3mf):
    base = (
        '<basematerials id="5"><base name="a" displaycolor="#FF0000"/><base name="b" '
        'displaycolor="#0000FFFF"/>'
    )
    resources = f"{base}</basematerials>" + solid(1, 'pid="5" pindex="1"', 'pid="5" p1="0"')
    mesh, _ = read_3mf(resources)
    colours = mesh.colours
    assert (colours.corners[:6] == [255, 0, 0]).all()
    assert (colours.corners[6:] == [0, 0, 255]).all()
    group = (
        '<m:colorgroup id="6"><m:color color="#00FF00"/><m:color color="#000000"/></m:colorgroup>'
    )
    # a corner without an entry has that of the first
    for words in ('p1="0" p2="1" p3="0"', 'p1="0" p2="1"'):
        resources = group + solid(1, "", f'pid="6" {words}')
        colours = read_3mf(resources)[0].colours
        assert colours.corners[0].tolist() == [[0, 255, 0], [0, 0, 0], [0, 255, 0]]
    texture = '<m:texture2d id="7" path="/3D/a.png" contenttype="image/png"/>'
    texture += '<m:texture2dgroup id="8" texid="7"><m:tex2coord u="0" v="0"/>'
    texture += '<m:tex2coord u="1" v="0"/><m:tex2coord u="0" v="1"/></m:texture2dgroup>'
    resources = texture + solid(1, "", 'pid="8" p1="0" p2="1" p3="2"')
    pictures = {"3D/a.png": encoded(noise())}
    mesh, texts = read_3mf(resources, more=pictures)
    colours = mesh.colours
    assert not texts
    np.testing.assert_array_equal(colours.textures[0], noise())
    assert colours.uv[0].tolist() == [[0, 0], [1, 0], [0, 1]]
    assert "/3D/a.png is missing" in read_3mf(resources)[1][0]
    other = solid(1, "", 'pid="9" p1="0"')
    assert "of a kind that is not read" in read_3mf(other)[1][0]


def test_threemf_of_several_models(read_3mf):
    resources = (
        '<object id="1"><components><component p:path="/3D/Objects/a.model" '
        'objectid="3"/></components></object>'
    )
    mesh, _ = read_3mf(resources, more={"3D/Objects/a.model": model(solid(3), "")})
    assert mesh.extents.tolist() == [30.0, 20.0, 10.0]


def test_threemf_starts_with_the_model_that_it_names(read_3mf):
    kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
    relation = (
        f'<Relationships><Relationship Target="/other/a.model" Type="{kind}"/></Relationships>'
    )
    more = {"_rels/.rels": relation, "other/a.model": model(solid(1, shape=SMALL))}
    mesh, _ = read_3mf(solid(1), more=more)
    assert mesh.extents.tolist() == [3.0, 2.0, 1.0]


def test_hostile_threemf_files_are_refused(tmp_path, refused, bounded):
    path = tmp_path / "a.3mf"
    circle = '<object id="1"><components><component objectid="1"/></components></object>'
    many = "".join(
        f'<object id="{k}"><components>{f"""<component objectid="{k + 1}"/>""" * 10}</components></object>'  # noqa: E501
        for k in range(1, 9)
    )
    for resources, items, match in (
        (circle, ITEM, "circle"),
        (many + solid(9), ITEM, "more than 10,000 parts"),
        (solid(1), '<item objectid="7"/>', "which it lacks"),
        (solid(1), '<item objectid="1" transform="1 2 3"/>', "12 numbers"),
        (solid(1).replace('v1="0"', 'v1="99"'), ITEM, "a vertex that the file lacks"),
        (solid(1).replace('v1="0"', 'v1="-1"'), ITEM, "a vertex that the file lacks"),
        (solid(1).replace('x="', 'x="x'), ITEM, "cannot be read"),
        ("<object", ITEM, "damaged XML"),
    ):
        refused("a.3mf", threemf(path, resources, items).read_bytes(), match)
    refused("a.3mf", b"PK\3\4 no archive", "no zip archive")
    threemf(path, solid(1), unit='unit="mile"')
    refused("a.3mf", path.read_bytes(), "its unit 'mile' is unknown")
    threemf(path, solid(1) + " " * 1_000_000)
    assert path.stat().st_size < 10_000
    bounded(path, "unpacks to more than 500,000 bytes", reader, "MAX_MESH_BYTES", 500_000)


ROBOT = """<robot name="arm"><material name="blue"><color rgba="0 0 1 1"/></material>
<link name="base"><visual><geometry><mesh filename="{base}"/></geometry><material name="blue"/></visual></link>
<link name="tip"><visual><origin xyz="0 0 0.5" rpy="0 0 1.5707963267948966"/><geometry><mesh filename="meshes/tip.ply"
scale="0.01 0.01 0.01"/></geometry></visual></link>
<link name="ball"><visual><geometry><sphere radius="0.25"/></geometry></visual></link>
<joint name="j" type="revolute"><parent link="base"/><child link="tip"/><origin xyz="1 0 0"
rpy="0 1.5707963267948966 0"/></joint>
<joint name="k" type="fixed"><parent link="tip"/><child link="ball"/><origin xyz="0 0 2"/></joint></robot>
"""  # noqa: E501


def arm(folder, base="package://arm/meshes/base.stl"):
    (folder / "meshes").mkdir(exist_ok=True, parents=True)
    SMALL.export(folder / "meshes" / "base.stl")
    BOX.export(folder / "meshes" / "tip.ply")
    path = folder / "arm.urdf"
    path.write_text(ROBOT.format(base=base))
    return path


def test_urdf_gives_all_links_with_the_joints_at_zero(tmp_path, load):
    mesh = cr.load_mesh(arm(tmp_path))
    assert (mesh.unit, mesh.up) == ("m", "z")
    # The tip's box of 0.3 x 0.2 x 0.1 is turned about z, lies 0.5 along z, and z is turned to x.
    assert_allclose(mesh.bounds[0], [-1.5, -1.0, -0.5], atol=1e-6)
    assert mesh.bounds[1][0] == pytest.approx(3.25, abs=0.01)
    tip, _ = load(tmp_path / "arm.urdf", link="tip")
    assert_allclose(tip.bounds, [[-0.1, -0.15, 0.45], [0.1, 0.15, 0.55]], atol=1e-6)
    names = {path.name for path in mesh_files(tmp_path / "arm.urdf")}
    assert names == {"arm.urdf", "base.stl", "tip.ply"}
    assert (mesh.colours.corners[:12] == [0, 0, 255]).all()
    with refused(r"no link 'hand'; it has base, tip, ball", MeshError):
        cr.load_mesh(tmp_path / "arm.urdf", link="hand")
    with refused("only a URDF has links", MeshError):
        cr.load_mesh(tmp_path / "meshes" / "base.stl", link="tip")


def test_urdf_names_meshes_that_it_does_not_find(tmp_path, load):
    path = arm(tmp_path / "urdf", "package://arm/other/base.stl")
    assert "other/base.stl is missing in its folder" in load(path)[1][0]
    (tmp_path / "other").mkdir()
    SMALL.export(tmp_path / "other" / "base.stl")
    mesh = cr.load_mesh(path, textures=tmp_path)
    assert mesh.bounds[0][0] == pytest.approx(-1.5)


def test_urdf_reads_capsules_and_names_other_shapes(tmp_path, load):
    capsule = '<geometry><capsule radius="0.5" length="2"/></geometry>'
    torus = "<geometry><torus/></geometry>"
    mesh, said = load(robot(tmp_path / "a.urdf", capsule, torus))
    assert_allclose(mesh.bounds, [[-0.5, -0.5, -1.5], [0.5, 0.5, 1.5]], atol=1e-6)
    assert "its shape torus is not read and is left out" in said[0]


PLACES = """
arm_description/urdf   | true        | true
arm_description/robots | true        | true
arm_description/robots | false       | false
arm_description/other  | true        | false
arm_description/other  | package.xml | true
other/urdf             | true        | false
"""


@pytest.mark.parametrize(("place", "names_package", "is_found"), text_table(PLACES))
def test_meshes_of_a_package_are_found_from_its_folder_urdf(
    tmp_path, load, place, names_package, is_found
):
    folder = tmp_path / place
    folder.mkdir(parents=True)
    (folder.parent / "meshes").mkdir()
    SMALL.export(folder.parent / "meshes" / "base.stl")
    if names_package == "package.xml":
        (folder.parent / "package.xml").write_text("<package/>")
    name = "package://arm_description/meshes/base.stl" if names_package else "meshes/base.stl"
    path = robot(folder / "arm.urdf", mesh_of_robot(name))
    if is_found:
        assert load(path)[0].extents.tolist() == [3.0, 2.0, 1.0]
        return
    text = rf"the meshes that it names are missing in its folder \({name}\); name their folder"
    with refused(text, MeshError):
        cr.load_mesh(path)


def test_hostile_urdf_files_are_refused(tmp_path, refused, bounded):
    path = arm(tmp_path)
    text = path.read_text()
    joint = '<joint name="l" type="fixed"><parent link="ball"/><child link="base"/></joint></robot>'
    for changed, match in (
        (text.replace("</robot>", joint), "joints form a circle"),
        (text.replace("<robot", "<!DOCTYPE robot><robot"), "document type"),
        (text.replace("robot", "xacro"), "no robot in it"),
        (text.replace('xyz="1 0 0"', 'xyz="1 nan 0"'), "expected 3 numbers"),
        (text.replace('radius="0.25"', ""), "expected 1 numbers"),
        (text.replace("meshes/tip.ply", "arm.urdf"), "names a URDF as a mesh"),
        ("<robot>", "cannot be read"),
    ):
        refused("arm.urdf", changed, match)
    path.write_text(text)
    bounded(path, "more than 20 faces", limits, "MAX_MESH_FACES", 20)
