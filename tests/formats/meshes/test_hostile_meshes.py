"""Malicious mesh files end in a one-line error, soon and in little memory."""

import json
import struct
import time
import tracemalloc

import numpy as np
import pytest
import trimesh

import curvireg_torch as cr
from curvireg_torch.errors import MeshError
from curvireg_torch.formats.meshes import limits, polygons, source
from curvireg_torch.mesh import mesh as mesh_module
from tests._support.tables import text_table
from tests.formats.meshes.test_gltf import TRIANGLE, Tree
from tests.formats.meshes.test_ply import header, rows

POINTS = np.array(TRIANGLE, "<f4").tobytes()


def tree(**changes):
    """A triangle as glTF."""
    content = Tree()
    content.part(None, TRIANGLE)
    return {**content.whole(), **changes}


def glb(content):
    text = json.dumps({**content, "buffers": [{"byteLength": 36}]}).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", 36, b"BIN\0") + POINTS
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def refused(path, content, match, *, seconds=5.0, megabytes=100.0):
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    tracemalloc.start()
    start = time.process_time()
    with pytest.raises(MeshError, match=match) as caught:
        cr.load_mesh(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.process_time() - start < seconds
    assert peak < megabytes * 1e6
    assert len(str(caught.value).splitlines()) == 1
    assert path.name in str(caught.value)


def test_load_mesh_reads_the_valid_gltf_and_glb_and_refuses_damaged_glb(tmp_path, write):
    write("a.gltf", tree())
    write("a.glb", glb(tree()))
    areas = [cr.load_mesh(tmp_path / name).surface.area for name in ("a.gltf", "a.glb")]
    assert areas == [0.5, 0.5]
    for damaged in (
        b"glTF",
        glb(tree())[:60],
        glb(tree())[:-5],
        glb(tree()).replace(b"JSON", b"TEXT"),
    ):
        refused(tmp_path / "a.glb", damaged, "cannot be read")


CHANGES = """
{"nodes": [{"children": [1]}, {"children": [0], "mesh": 0}]}  | circle
{"nodes": [{"children": [0], "mesh": 0}]}                     | circle
{"nodes": [{"children": [1, 1]}, {"mesh": 0}]}                | child of several
{"nodes": [{"children": [7], "mesh": 0}]}                     | missing
{"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}}]} | gpu_instancing, which is not read; export without it
{"bufferViews": [{"buffer": 0, "byteLength": 1000000000000}]} | claim more than
{"bufferViews": [{"buffer": 0, "byteLength": 100}]}           | cannot be read
{"buffers": [{"byteLength": 36}]}                             | cannot be read
{"extensionsRequired": ["KHR_draco_mesh_compression"]}        | KHR_draco_mesh_compression.*export without it
{"extensionsRequired": ["EXT_meshopt_compression"]}           | EXT_meshopt_compression.*export without it
{"asset": {"version": "1.0"}}                                 | version 2
{"meshes": 5}                                                 | valid glTF
{"accessors": [{"componentType": 5126, "count": 30000000, "type": "VEC3"}]} | has no data
{"accessors": [{"componentType": 5126, "count": 30000000, "type": "VEC3", "sparse": {"count": 1, "indices": {"bufferView": 0, "componentType": 5121}, "values": {"bufferView": 0}}}]} | more values than
"""  # noqa: E501
ACCESSORS = """
{"count": 1000000000}    | claim more than
{"count": 1000000}       | cannot be read
{"count": -3}            | "-3"
{"sparse": {"count": 1}} | valid glTF
"""
WHOLE_ACCESSOR = tree()["accessors"][0]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        *text_table(CHANGES),
        *(
            ({"accessors": [{**WHOLE_ACCESSOR, **changes}]}, match)
            for changes, match in text_table(ACCESSORS)
        ),
        ({"nodes": [{"mesh": 0}] * 20_000}, "10,000 parts"),
    ],
)
def test_check_gltf_refuses_what_is_not_read_or_too_large(tmp_path, changes, match):
    refused(tmp_path / "a.gltf", json.dumps(tree(**changes)), match)
    if "buffers" not in changes:
        refused(tmp_path / "a.glb", glb(tree(**changes)), match)


OUTSIDE = [
    "../b.bin",
    "/etc/passwd",
    "file:///etc/passwd",
    "http://127.0.0.1:9/b.bin",
    "%2e%2e/b.bin",
]


@pytest.mark.parametrize("uri", [*OUTSIDE, "link.bin", "Linked/b.bin", "linked/b.bin", "no.bin"])
def test_load_mesh_opens_no_file_outside_the_folder(tmp_path, write, uri):
    folder = tmp_path / "inside"
    folder.mkdir()
    (folder / "link.bin").symlink_to(write("b.bin", POINTS))
    # names that differ in upper and lower case only are searched for: in links to folders too
    other = write("other/b.bin", POINTS).parent
    (folder / "Linked").symlink_to(other, target_is_directory=True)
    content = tree(buffers=[{"byteLength": 36, "uri": uri}])
    refused(folder / "a.gltf", json.dumps(content), "no file of its folder")


QUAD = header(count=1) + rows([""] * 4)
BINARY = header(points=10**9, count=9_000_000, kind="binary_little_endian")


def test_load_mesh_refuses_false_claims_and_bounds_its_work(tmp_path, monkeypatch):
    for name, content, match in (
        ("a.off", b"OFF\n1000000000 1000000000 0\n0 0 0\n", "too early"),
        ("a.off", b"OFF\n-1 1 0\n0 0 0\n", "too early"),
        ("a.off", b"OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2\n", "too early"),
        ("a.off", b"4OFF\n3 1 0\n0 0 0 2\n1 0 0 2\n1 1 0 2\n3 0 1 2\n", "more than three"),
        ("a.ply", QUAD + "4 0 1 2\n", "ends within its last row"),
        (
            "a.ply",
            header(face="property float s\n", count=1) + rows([""] * 4) + "4 0 1 2 3",
            "ends within its last row",
        ),
        ("a.ply", BINARY + "\0\0", "early"),
        ("a.ply", header(points=1) + "0 0 0\n3 0 0 0\n", "ends before the last face"),
        ("a.stl", b"\0" * 80 + struct.pack("<I", 10**9) + b"\0" * 50, "it was cut while"),
        ("a.gltf", b'{"asset": ' + b"[" * 1_000_000, "RecursionError"),
        ("a.obj", b"v 0 0 0\nv 1e300 0 0\nv 0 1 0\nf 1 2 3\n", r"1e\+12"),
        (
            "a.obj",
            b"v 0 0 0\nv 9e-7 0 0\nv 0 1e-9 0\nf 1 2 3\n",
            "only 9e-07 units across; scale it up",
        ),
        ("a.obj", b"v 0 0 0\n" * 9 + b"f " + b"1 2 3 " * 2_000 + b"\n", "degenerate"),
    ):
        refused(tmp_path / name, content, match)
    trimesh.creation.icosphere(3).export(tmp_path / "a.stl")
    content = (tmp_path / "a.stl").read_bytes()
    monkeypatch.setattr(mesh_module, "MAX_MESH_FACES", 1000)
    refused(tmp_path / "a.stl", content, "1,280 faces")
    copies = json.dumps(tree(nodes=[{"mesh": 0}] * 200))
    monkeypatch.setattr(limits, "MAX_MESH_FACES", 100)
    refused(tmp_path / "a.gltf", copies, "more than 100 faces")
    monkeypatch.setattr(source, "MAX_MESH_BYTES", 1000)
    refused(tmp_path / "a.stl", content, "larger than 1,000 bytes")


def test_load_mesh_places_parts_of_a_deep_tree_in_linear_time(tmp_path, write):
    """trimesh alone multiplies the whole chain again for each part."""
    chain = [{"children": [i + 1], "translation": [0.01, 0, 0]} for i in range(179)]
    leaves = [{"mesh": 0, "translation": [0, 0, 0.1 * i]} for i in range(500)]
    nodes = [*chain, {"children": list(range(180, 680))}, *leaves]
    write("a.gltf", tree(nodes=nodes))
    start = time.process_time()
    mesh = cr.load_mesh(tmp_path / "a.gltf")
    assert time.process_time() - start < 10
    assert len(mesh.faces) == 500
    np.testing.assert_allclose(mesh.bounds, [[1.79, 0, 0], [2.79, 1, 49.9]])


def test_faces_are_counted_before_they_are_divided(tmp_path, write, monkeypatch):
    dart = "0 0 0\n1 2 0\n0 1 0\n-1 2 0\n" + "4 0 1 2 3\n" * 10
    obj = "v 0 0 0\nv 1 2 0\nv 0 1 0\nv -1 2 0\n" + "f 1 2 3 4\n" * 10
    for name, content in (
        ("a.off", f"OFF\n4 10 0\n{dart}"),
        ("a.ply", header(count=10) + dart),
        ("a.obj", obj),
    ):
        monkeypatch.undo()
        write(name, content)
        assert len(cr.load_mesh(tmp_path / name).faces) == 20
        monkeypatch.setattr(polygons, "MAX_POLYGON_WORK", 159)
        refused(tmp_path / name, content, "not convex have too many corners")
        for limit, value, words in (("FACES", 19, "19 faces"), ("LINES", 9, "9 lines")):
            monkeypatch.setattr(limits, f"MAX_MESH_{limit}", value)
            refused(tmp_path / name, content, f"more than {words}")
    monkeypatch.undo()
    monkeypatch.setattr(polygons, "MAX_POLYGON_WORK", 160)
    assert len(cr.load_mesh(tmp_path / "a.off").faces) == 20
