"""glTF as scanners and modellers export it."""

import base64
import json
import time
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from curvireg_torch.errors import MeshError
from tests._support.refusals import refused
from tests._support.tables import text_table
from tests.formats.meshes.pictures import encoded

BOX = trimesh.creation.box((3.0, 2.0, 1.0))
TRIANGLE = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]
TYPES = {"f": 5126, "B": 5121, "H": 5123, "I": 5125, "b": 5120, "h": 5122}


class Tree:
    """A glTF file under construction: arrays become accessors of one buffer."""

    def __init__(self):
        self.data = b""
        self.content: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "accessors": [],
            "bufferViews": [],
        }

    def array(self, values, dtype="f", **more):
        """The number of the accessor, and of its view."""
        x = np.asarray(values, dtype)
        x = x[:, None] if x.ndim == 1 else x
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[x.shape[1]]
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": x.nbytes}
        self.data += x.tobytes()
        number = len(self.content["accessors"])
        stored = {"bufferView": number, "componentType": TYPES[dtype], "count": len(x)}
        self.content["bufferViews"].append(view)
        self.content["accessors"].append({**stored, "type": kind, **more})
        return number

    def part(self, indices=None, positions=BOX.vertices, **more):
        part = {"attributes": {"POSITION": self.array(positions)}, **more}
        if indices is not None:
            part["indices"] = self.array(np.ravel(indices), "I")
        self.content["meshes"][0]["primitives"].append(part)
        return part

    def picture(self, pixels):
        uri = "data:image/png;base64," + base64.b64encode(encoded(pixels)).decode()
        self.content |= {"images": [{"uri": uri}], "textures": [{"source": 0}]}

    def whole(self, uri=None):
        """The content, whose data are in a file, or in itself."""
        uri = uri or "data:;base64," + base64.b64encode(self.data).decode()
        return {**self.content, "buffers": [{"byteLength": len(self.data), "uri": uri}]}

    def write(self, path, uri=None):
        path.write_text(json.dumps(self.whole(uri)))
        return path


def skinned(joints, weights, *nodes, **skin):
    """A triangle with a skin, whose joints are these nodes; of each corner, or of all, the joints
    and their weights."""
    tree = Tree()
    part = tree.part(None, TRIANGLE)
    part["attributes"]["JOINTS_0"] = tree.array(np.broadcast_to(joints, (3, 4)), "B")
    part["attributes"]["WEIGHTS_0"] = tree.array([weights] * 3)
    numbers = [*range(1, len(nodes) + 1)]
    binds = {name: tree.array(np.reshape(values, (-1, 16))) for name, values in skin.items()}
    tree.content["skins"] = [{"joints": numbers, **binds}]
    tree.content["nodes"] = [{"mesh": 0, "skin": 0}, *nodes]
    tree.content["scenes"] = [{"nodes": [0, *numbers]}]
    return tree


def textured(more, material=None):
    """A triangle with two sets of coordinates, and a texture; ``more`` is said of its use."""
    tree = Tree()
    part = tree.part(None, TRIANGLE, material=0)
    part["attributes"]["TEXCOORD_0"] = tree.array([[0, 0], [1, 0], [0, 0.5]])
    part["attributes"]["TEXCOORD_1"] = tree.array([[0.25, 0], [0.25, 0], [0.25, 0]])
    tree.picture(np.full((4, 4, 3), 255, np.uint8))
    used = {"baseColorTexture": {"index": 0, **more}, "baseColorFactor": [1, 0, 0, 1]}
    tree.content["materials"] = [material or {"pbrMetallicRoughness": used}]
    return tree


def coordinates(mesh):
    return mesh.colours.uv[0] * [1, -1] + [0, 1]  # from the top left, as in glTF


def test_strips_have_all_their_faces_and_lines_none(read):
    square = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    for indices in (None, [0, 1, 2, 3]):
        tree = Tree()
        tree.part(indices, square, mode=5)
        tree.part(None, square, mode=1)
        mesh, _ = read(tree)
        assert (len(mesh.faces), mesh.surface.area) == (2, 1.0)
        assert (mesh.surface.face_normals[:, 2] > 0.99).all(), (
            "every second face of a strip is turned over"
        )


def test_values_may_lie_apart_behind_others(read):
    tree = Tree()
    tree.part(None, np.c_[[9.0] * 3, TRIANGLE])
    tree.content["accessors"][0] |= {"type": "VEC3", "byteOffset": 4}
    tree.content["bufferViews"][0]["byteStride"] = 16
    assert read(tree)[0].vertices.tolist() == TRIANGLE


def sparse(tree, index, values, kind="B"):
    """What an accessor says of ``values`` at places that differ from its own."""
    return {
        "count": len(index),
        "indices": {"bufferView": tree.array(index, kind), "componentType": TYPES[kind]},
        "values": {"bufferView": tree.array(values)},
    }


@pytest.mark.parametrize("kind", ["B", "H", "I"])
def test_sparse_accessors_replace_some_of_their_values(read, loaded, kind):
    """As exporters write what differs from a copy, or from zeros where there is no view."""
    moved = [0, 7]
    tree = Tree()
    tree.part(BOX.faces)
    accessor = tree.content["accessors"][0]
    accessor["sparse"] = sparse(tree, moved, BOX.vertices[moved] * 3.0, kind)
    expected = BOX.vertices.copy()
    expected[moved] *= 3.0
    mesh = loaded(tree)
    assert_allclose(mesh.surface.triangles, expected[BOX.faces], atol=1e-6)
    del accessor["bufferView"]
    accessor["sparse"] = sparse(tree, [*range(7)], BOX.vertices[:7], kind)
    expected = np.vstack([BOX.vertices[:7], np.zeros(3)])
    mesh, _ = read(tree)
    assert_allclose(mesh.surface.triangles, expected[BOX.faces], atol=1e-6)


SPARSE = """
{"count": 9}                                           | more values than it has
{"count": 3}                                           | longer than its data
{"count": -1}                                          | integer >= 0
{"values": {}}                                         | no data
{"indices": {"componentType": 5121}}                   | no data
{"indices": {"componentType": 5120, "bufferView": 2}}  | does not have
{}                                                     | does not have
"""


@pytest.mark.parametrize(("changes", "match"), text_table(SPARSE))
def test_damaged_sparse_accessors_are_refused(read, changes, match):
    tree = Tree()
    tree.part(BOX.faces)
    accessor = tree.content["accessors"][0]
    accessor["sparse"] = {**sparse(tree, [1, 255], BOX.vertices[:2]), **changes}
    with refused(match, MeshError):
        read(tree)


@pytest.mark.parametrize(("dtype", "largest"), [("B", 255), ("H", 65535), ("f", 1)])
def test_vertex_colours_are_multiplied_by_the_material(loaded, dtype, largest):
    tree = Tree()
    shades = np.linspace(0, 1, 8)
    colours = np.stack([shades, 1 - shades, shades, np.ones(8)], axis=1)
    part = tree.part(BOX.faces, material=0)
    part["attributes"]["COLOR_0"] = tree.array(colours * largest, dtype, normalized=dtype != "f")
    factor = [0.5, 1.0, 0.0, 1.0]  # 0.5 is 0.7354 of sRGB
    tree.content["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": factor}}]
    mesh = loaded(tree)
    expected = 255 * colours[BOX.faces][..., :3] * [0.7354, 1.0, 0.0]
    assert_allclose(mesh.colours.corners, expected, atol=1.0)


TRANSFORMS = """
{}                                            | [[0, 0], [1, 0], [0, 0.5]]
{"offset": [0.5, 0.25]}                       | [[0.5, 0.25], [1.5, 0.25], [0.5, 0.75]]
{"scale": [2, 3]}                             | [[0, 0], [2, 0], [0, 1.5]]
{"rotation": 1.57079632679, "offset": [1, 0]} | [[1, 0], [1, -1], [1.5, 0]]
{"rotation": 1.57079632679, "scale": [2, 1]}  | [[0, 0], [0, -2], [0.5, 0]]
"""


@pytest.mark.parametrize(("transform", "expected"), text_table(TRANSFORMS))
@pytest.mark.parametrize("said", ["extensionsRequired", "extensionsUsed"])
def test_texture_coordinates_are_transformed(loaded, transform, expected, said):
    """In the file (0, 0) is the top left; here it is the bottom left."""
    tree = textured({"extensions": {"KHR_texture_transform": transform}})
    tree.content[said] = ["KHR_texture_transform"]
    mesh = loaded(tree)
    assert_allclose(coordinates(mesh), expected, atol=1e-6)


def test_a_texture_without_coordinates_or_format_is_named(read):
    tree = Tree()
    tree.picture(np.zeros((4, 4, 3), np.uint8))
    tree.part(BOX.faces, material=0)
    tree.content["materials"] = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 2}}}
    ]
    assert "lacks TEXCOORD_2" in read(tree)[1][0]
    tree.content["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    tree.content["extensionsRequired"] = ["KHR_texture_basisu"]
    assert "in a format that is not read" in read(tree)[1][0]


def test_morph_targets_are_named(read):
    tree = Tree()
    tree.part(BOX.faces)
    tree.content["meshes"][0]["weights"] = [0.5]
    assert "morph targets are left out" in read(tree)[1][0]
    tree.content["nodes"] = [{"mesh": 0, "weights": [0.0]}]
    assert read(tree)[1] == []
    tree.content["meshes"][0]["weights"] = [0.0]
    tree.content["nodes"] = [{"mesh": 0, "weights": [0.5]}]
    assert "morph targets are left out" in read(tree)[1][0]


def test_invisible_nodes_and_their_children_are_left_out(read):
    tree = Tree()
    tree.part(BOX.faces)
    hidden = {"KHR_node_visibility": {"visible": False}}
    nodes = [{"mesh": 0}, {"children": [2], "extensions": hidden}, {"mesh": 0}]
    tree.content |= {"nodes": nodes, "scenes": [{"nodes": [0, 1]}]}
    mesh, said = read(tree)
    assert len(mesh.faces) == 12
    assert "its invisible parts are left out" in said[0]


DAMAGED = """
{"skins": [{"joints": [7]}]}
{"materials": [{"pbrMetallicRoughness": {"baseColorFactor": [1, 2]}}]}
{"materials": [{"pbrMetallicRoughness": {"baseColorFactor": "red"}}]}
{"materials": []}
{"nodes": [{"mesh": 0, "rotation": [1, 0]}]}
{"nodes": [{"mesh": 3}]}
"""


@pytest.mark.parametrize("row", text_table(DAMAGED))
def test_damaged_trees_are_refused(read, row):
    tree = Tree()
    part = tree.part(BOX.faces, material=0)
    part["attributes"] |= {
        "JOINTS_0": tree.array([[9] * 4] * 8, "B"),
        "WEIGHTS_0": tree.array([[1, 0, 0, 0]] * 8),
    }
    tree.content |= {
        "nodes": [{"mesh": 0, "skin": 0}],
        "materials": [{}],
        "skins": [{"joints": [0]}],
        **row[0],
    }
    with refused("cannot be read as a mesh", MeshError):
        read(tree)


def test_parts_share_a_view_without_copies(read):
    """A thousand accessors of one view of 20 MB, and too many nodes."""
    tree = Tree()
    tree.part(None, TRIANGLE)
    tree.data += bytes(20_000_000)
    tree.content["bufferViews"][0]["byteLength"] = len(tree.data)
    tree.content["accessors"] *= 1000
    primitives = [{"attributes": {"POSITION": k}} for k in range(1000)]
    tree.content["meshes"][0]["primitives"] = primitives
    start = time.process_time()
    assert len(read(tree)[0].faces) == 1000
    assert time.process_time() - start < 3.0
    tree.content["nodes"] += [{}] * 100_001
    with refused("more than 100,000 nodes", MeshError):
        read(tree)
