"""USD files, which are generated: their places, units, axes, colours and textures."""

import zipfile

import pytest
from numpy.testing import assert_allclose

import curvireg_torch as cr
from curvireg_torch.formats.meshes import usd
from curvireg_torch.formats.meshes.files import mesh_files
from curvireg_torch.utils import programs
from curvireg_torch.utils.extras import is_installed
from tests.formats.meshes.packages import stage
from tests.formats.meshes.pictures import encoded, painted

pytestmark = [
    pytest.mark.skipif(not is_installed("pxr"), reason="usd-core is not installed"),
    pytest.mark.usefixtures("here"),
]

SQUARE = """
    def Mesh "square" ({api})
    {{
        point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0)]
        int[] faceVertexCounts = [{counts}]
        int[] faceVertexIndices = [{indices}]
        {more}
    }}
"""
MATERIAL = """
    def Material "paint"
    {
        token outputs:surface.connect = </part/paint/shader.outputs:surface>
        def Shader "shader"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </part/paint/print.outputs:rgb>
            token outputs:surface
        }
        def Shader "print"
        {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @textures/print.png@
            float2 inputs:st.connect = </part/paint/reader.outputs:result>
            float3 outputs:rgb
        }
        def Shader "reader"
        {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "map"
            float2 outputs:result
        }
    }
"""
BOUND = 'prepend apiSchemas = ["MaterialBindingAPI"]'
MAP = """rel material:binding = </part/paint>
        texCoord2f[] primvars:map = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "faceVarying")
"""


def square(more="", api="", counts="4", indices="0, 1, 2, 3"):
    return SQUARE.format(more=more, api=api, counts=counts, indices=indices)


def textures_of(mesh):
    return [texture[0, 0].tolist() for texture in mesh.colours.textures]


def write_print(folder, picture):
    """The texture of ``MATERIAL``."""
    (folder / "textures").mkdir(parents=True)
    (folder / "textures" / "print.png").write_bytes(picture)


def package(path, text, **more):
    """A USDZ: a zip without compression, whose contents begin at multiples of 64 bytes."""
    with zipfile.ZipFile(path, "w") as file:
        for name, content in {"part.usda": text.encode(), **more}.items():
            entry = zipfile.ZipInfo(name.replace("__", "/").replace("_png", ".png"))
            end = file.fp.tell() + 30 + len(entry.filename.encode())
            padding = -(end + 4) % 64
            entry.extra = b"\x86\x19" + padding.to_bytes(2, "little") + bytes(padding)
            file.writestr(entry, content)
    return path


def test_places_units_axes_and_polygons(read_usd):
    place = (
        "    double3 xformOp:translate = (10, 0, 5)\n    double3 xformOp:rotateXYZ = (90, 0, 0)\n"
    )
    place += '    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]\n'
    inner = "double3 xformOp:translate = (0, 0, 7)\n"
    inner += '        uniform token[] xformOpOrder = ["xformOp:translate"]'
    mesh, texts = read_usd(square(inner), place=place)
    assert (mesh.unit, mesh.up, texts) == ("mm", "z", [])
    assert_allclose(mesh.bounds, [[10, -7, 5], [12, -7, 6]], atol=1e-6)
    assert_allclose(mesh.surface.face_normals, [[0, -1, 0]] * 2, atol=1e-6)
    assert not mesh.has_colours
    mesh, _ = read_usd(square('uniform token orientation = "leftHanded"'), place=place)
    assert_allclose(mesh.surface.face_normals, [[0, 1, 0]] * 2, atol=1e-6)


@pytest.mark.parametrize(
    ("about", "unit", "up", "width"),
    [
        ('metersPerUnit = 0.01\n    upAxis = "Y"', "cm", "y", 2.0),
        ("metersPerUnit = 0.5", "m", "y", 1.0),  # a unit without a name
        ('upAxis = "Z"', "cm", "z", 2.0),  # not stated: OpenUSD's centimetres
    ],
)
def test_units_and_axes_are_those_of_the_stage(tmp_path, read_usd, load, about, unit, up, width):
    mesh, _ = read_usd(square(), about=about)
    assert (mesh.unit, mesh.up) == (unit, up)
    assert mesh.extents[0] == pytest.approx(width)
    if "metersPerUnit" not in about:
        assert load(tmp_path / "part.usda", unit="mm")[0].unit == "mm"


def test_colours_of_the_mesh(read_usd):
    colours = "color3f[] primvars:displayColor = [(1, 0, 0), (0, 0, 1)]"
    more = colours + ' (interpolation = "uniform")'
    mesh, _ = read_usd(square(more, counts="3, 3", indices="0, 1, 2, 0, 2, 3"))
    assert mesh.colours.corners[:, 0].tolist() == [[255, 0, 0], [0, 0, 255]]
    assert mesh.has_colours
    mesh, _ = read_usd(square(), place="    color3f[] primvars:displayColor = [(0, 0, 1)]\n")
    assert mesh.colours.corners[0, 0].tolist() == [0, 0, 255], "of the group"


def test_a_colour_that_is_an_input_of_the_material(read_usd):
    named = MATERIAL.replace("paint/print.outputs:rgb", "paint.inputs:colour")
    surface = "        token outputs:surface.connect"
    named = named.replace(surface, f"        color3f inputs:colour = (0, 1, 0)\n{surface}", 1)
    mesh, texts = read_usd(named, square(MAP, BOUND))
    assert not texts
    assert mesh.colours.corners[0, 0].tolist() == [0, 255, 0]


def test_textures_by_the_coordinates_that_they_name(tmp_path, read_usd, load):
    write_print(tmp_path, encoded([[[255, 0, 0]], [[0, 0, 255]]]))
    mesh, texts = read_usd(MATERIAL, square(MAP, BOUND))
    colours = mesh.colours
    assert not texts
    path = tmp_path / "part.usda"
    picture = tmp_path / "textures" / "print.png"
    assert mesh_files(path) == [path, picture]
    assert [texture[:, 0].tolist() for texture in colours.textures] == [[[255, 0, 0], [0, 0, 255]]]
    assert colours.uv.tolist() == [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]]
    picture.unlink()
    assert any("print.png is missing" in text for text in load(path)[1])


def test_textures_lie_beside_the_file_that_names_them(tmp_path, write, load):
    """A file of the same name beside the first one is another texture."""
    for folder, colour in ((".", (255, 0, 0)), ("blue", (0, 0, 255))):
        write_print(tmp_path / folder, painted(colour))
    # without ./ OpenUSD looks beside the first file too
    material = MATERIAL.replace("@textures", "@./textures")
    text = stage(material, square(MAP, BOUND), about='defaultPrim = "part"')
    (tmp_path / "blue" / "part.usda").write_text(text)
    path = write("all.usda", '#usda 1.0\ndef "a" (references = @blue/part.usda@)\n{\n}\n')
    assert textures_of(cr.load_mesh(path)) == [[0, 0, 255]]
    (tmp_path / "blue" / "textures" / "print.png").unlink()
    mesh, texts = load(path)
    assert textures_of(mesh) == []
    assert "blue/textures/print.png is missing" in texts[0]
    text = text.replace(material, MATERIAL)
    packed = package(tmp_path / "p[1].usdz", text, textures__print_png=painted((0, 255, 0)))
    for place in (packed, path):
        path.write_text('#usda 1.0\ndef "a" (references = @p[1].usdz@)\n{\n}\n')
        assert textures_of(cr.load_mesh(place)) == [[0, 255, 0]]


def test_a_texture_whose_file_is_an_input_of_the_material(write, read_usd):
    write("print.png", painted((1, 2, 3)))
    named = MATERIAL.replace(
        "asset inputs:file = @textures/print.png@",
        "asset inputs:file.connect = </part/paint.inputs:picture>",
    )
    surface = "        token outputs:surface.connect"
    named = named.replace(surface, f"        asset inputs:picture = @print.png@\n{surface}", 1)
    assert textures_of(read_usd(named, square(MAP, BOUND))[0]) == [[1, 2, 3]]


def test_textures_are_scaled(tmp_path, read_usd):
    write_print(tmp_path, painted((255, 255, 255)))
    for more, tint, count in (
        ("float4 inputs:scale = (0.2158605, 1, 0, 1)", [128, 255, 0], 0),
        ("float4 inputs:scale = (2, 1, 1, 1)", [255, 255, 255], 1),
        ("float4 inputs:bias = (0.1, 0, 0, 0)", [255, 255, 255], 1),
    ):
        scaled = MATERIAL.replace("asset inputs:file", f"{more}\n            asset inputs:file")
        mesh, texts = read_usd(scaled, square(MAP, BOUND))
        assert len(texts) == count
        assert mesh.colours.corners[0, 0].tolist() == tint


def test_references_stay_in_the_folder(write, refused):
    part = '#usda 1.0\n(\n    defaultPrim = "part"\n)\ndef Xform "part"\n{' + square() + "}\n"
    inner = write("in/other.usda", part)
    outer = write("other.usda", part)
    text = '#usda 1.0\ndef "a" (references = @{}@)\n{{\n}}\n'
    path = write("in/part.usda", text.format("./other.usda"))
    assert len(cr.load_mesh(path).faces) == 2
    assert mesh_files(path) == [path, inner]
    for name in ("../other.usda", outer):
        refused("in/part.usda", text.format(name), "outside of its folder; flatten it")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("#usda 1.0\n(", "not a USD file, or damaged"),
        ("a part", "not a USD file, or damaged"),
        (stage(square(indices="0, 1, 2, 9")), "does not exist"),
        (stage(square(counts="5")), "do not fit"),
        (stage('    def PointInstancer "a" {}'), "point instancers"),
        (stage('    def "a" (clips = {}) {}'), "value clips"),
        (
            stage('    def Cube "a" {}'),
            r"has no faces: parts that are no meshes are left out \(Cube\)",
        ),
    ],
)
def test_what_is_not_read_is_refused(refused, text, match):
    refused("part.usda", text, match)


def test_other_parts_are_named(read_usd):
    hidden = square('token visibility = "invisible"').replace('"square"', '"hidden"')
    mesh, texts = read_usd(square(), '    def Cube "a" {}', hidden)
    assert len(mesh.faces) == 2
    assert any("no meshes are left out (Cube)" in text for text in texts)


def test_bounds(write, monkeypatch, bounded):
    monkeypatch.undo()  # in a process of its own
    path = write("part.usda", stage(square()))
    bounded(path, "more than 1 faces", usd, "MAX_MESH_FACES", 1)
    bounded(path, "more than 0 parts", usd, "MAX_MESH_PARTS", 0)
    bounded(path, "more than 36 bytes", usd, "MAX_MESH_BYTES", 9)
    bounded(path, "took more than 0.001 seconds", programs, "MAX_CAD_SECONDS", 0.001)
