"""STL files as people have them."""

import struct

import numpy as np
import pytest
import trimesh

import curvireg_torch as cr

BOX = trimesh.creation.box((3.0, 2.0, 1.0))


def binary(header=b"exported", claimed=12, tail=b""):
    corners = np.asarray(BOX.triangles, "<f4")
    records = b"".join(struct.pack("<12x") + one.tobytes() + b"\0\0" for one in corners)
    return header.ljust(80) + struct.pack("<I", claimed) + records + tail


def ascii_stl(name="part", point="  vertex {:.4f} {:.4f} {:.4f}\n"):
    facets = "".join(
        "facet normal 0 0 0\n outer loop\n"
        + "".join(point.format(*corner) for corner in one)
        + " endloop\nendfacet\n"
        for one in BOX.triangles
    )
    return f"solid {name}\n{facets}endsolid {name}\n"


def check(mesh):
    assert (len(mesh.faces), mesh.extents.round(6).tolist()) == (12, [3.0, 2.0, 1.0])
    assert mesh.surface.volume == pytest.approx(6.0, rel=1e-6)


@pytest.mark.parametrize(
    "header",
    [b"exported", b"solid facet vertex", "solid Gehäuse".encode("latin-1")],
)
@pytest.mark.parametrize("tail", [b"", b"\r\n"])
def test_the_header_of_a_binary_file_says_nothing(write, header, tail):
    check(cr.load_mesh(write("a.stl", binary(header, tail=tail))))


@pytest.mark.parametrize("claimed", [5, 11])
def test_faces_behind_the_last_one_are_named(write, load, claimed):
    mesh, texts = load(write("a.stl", binary(claimed=claimed)))
    assert len(mesh.faces) == claimed
    assert f"it says {claimed} faces and holds 12: the others are left out" in texts[0]


ASCII = {
    "plain": ascii_stl().encode(),
    "tabs": ascii_stl(point="\t\tvertex\t{:.4f}\t{:.4f} {:e}\n").encode(),
    "gbk": ascii_stl("外壳").encode("gbk"),
    "bom": ascii_stl("vertex 1 2 3").encode("utf-8-sig"),
    "utf-16": ascii_stl().encode("utf-16"),
    "crlf": ascii_stl().replace("\n", "\r\n").encode(),
    "cr": ascii_stl().replace("\n", "\r").encode(),
    "blank": ("\n \n" + ascii_stl()).encode(),
}


@pytest.mark.parametrize("content", ASCII.values(), ids=ASCII)
def test_ascii_files_of_every_encoding(write, content):
    check(cr.load_mesh(write("a.stl", content)))


def test_an_ascii_file_that_is_cut_short_says_so(write, load):
    text = ascii_stl()
    mesh, texts = load(write("a.stl", text[: text.rindex("endsolid")]))
    check(mesh)
    assert "may have been cut short" in texts[0]


THREE = "does not have three coordinates"
WRITING = "says 12 faces and holds .*cut while it was written"


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (ascii_stl(point="  vertex {:.1f} {:.1f}\n"), THREE),
        (ascii_stl(point="  vertex {:.1f} {:.1f} {:.1f} 4\n"), THREE),
        (ascii_stl(point="  vertex {:.1f} {:.1f} x{:.1f}\n"), "not a number"),
        (b"solid", "has no faces: it does not end with endsolid"),
        (b"", "too early"),
        (b"nothing of the kind", "too early"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n" * 9, "is no STL file"),
        *((binary()[:-cut], WRITING) for cut in (1, 49, 50, 120, 599)),
        *(
            (ascii_stl().rpartition(end)[0], "it was cut short, or is damaged")
            for end in ("endfacet", "endloop", "vertex")
        ),
    ],
)
def test_damaged_files_are_refused(refused, content, match):
    refused("a.stl", content, match)
