"""What an uploaded file is, and archives; no page is needed."""

import struct
import zipfile

import numpy as np
import pytest
import trimesh

from curvireg_torch.errors import MAX_IMAGE_BYTES, MAX_MESH_BYTES, InvalidInputError
from curvireg_torch.viewer import uploads
from curvireg_torch.viewer.uploads import file_name, identify, size_limit, unpack

BINARY_STL = b"\0" * 80 + struct.pack("<I", 2) + b"\0" * 100


@pytest.mark.parametrize(
    ("name", "head", "expected"),
    [
        ("a.jpg", b"\xff\xd8\xff\xe0", ("photograph", "")),
        ("a.stl", b"\x89PNG\r\n", ("photograph", "")),  # the content decides
        ("holiday", b"RIFF1234WEBP", ("photograph", "")),
        ("a.heic", b"\0\0\0\x18ftypheic", ("photograph", "")),  # whose reader says what to do
        ("a.jpg", b"", ("photograph", "")),
        ("a.jpg", b"ply\nformat ascii 1.0", ("mesh", ".ply")),
        ("a.obj", b"solid part", ("mesh", ".stl")),
        ("part", BINARY_STL, ("mesh", ".stl")),
        ("part", b"glTF\2\0\0\0", ("mesh", ".glb")),
        ("part", b'{"asset": {"version": "2.0"}}', ("mesh", ".gltf")),
        ("part.txt", b"# from a scan\nv 0 0 1.5e-3\nv 1 0 0\n", ("mesh", ".obj")),
        ("A.OBJ", b"mtllib a.mtl", ("mesh", ".obj")),
        ("a.safetensors", b"\x10\0\0\0\0\0\0\0{}", ("mesh", ".safetensors")),
        ("a.stl", b"PK\3\4", ("archive", ".zip")),
    ],
)
def test_identify(name, head, expected):
    assert identify(name, head, len(head)) == expected


@pytest.mark.parametrize(
    ("name", "head"), [("a.pdf", b"%PDF-1.7"), ("a", b""), ("a.txt", b"v is for voyage\n"), ("a", BINARY_STL[:-1])]
)
def test_identify_names_the_file_that_is_neither(name, head):
    with pytest.raises(InvalidInputError, match=rf"^{name}: neither a photograph .* nor a mesh"):
        identify(name, head, len(head))


def test_size_limit_depends_on_the_kind():
    assert size_limit("a.JPG") == size_limit("a") == ("photograph", MAX_IMAGE_BYTES)
    assert size_limit("a.GLB") == size_limit("a.zip") == ("mesh", MAX_MESH_BYTES)
    for name in ("part.mtl", "part.bin"):
        with pytest.raises(InvalidInputError, match=rf"^{name}: .*zip archive"):
            size_limit(name)


def test_file_name_has_no_folders():
    assert file_name("../../etc/passwd") == "passwd"
    assert file_name("C:\\a\\b.png") == "b.png"
    assert file_name("a\nb\x1b.png") == "ab.png"
    assert file_name("") == file_name("a/") == "file"
    assert file_name("x" * 500 + ".png").endswith("x.png")
    assert len(file_name("x" * 500)) == 120


def pack(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_unpack_finds_the_mesh_among_its_parts(tmp_path):
    scene = trimesh.Scene(trimesh.creation.box())
    files = trimesh.exchange.gltf.export_gltf(scene)
    parts = {f"part/{name}": content for name, content in files.items()}
    archive = pack(tmp_path / "a.zip", {**parts, "__MACOSX/part/._model.gltf": b"x"})
    mesh = unpack(archive, tmp_path / "unpacked", "a.zip")
    assert mesh == tmp_path / "unpacked" / "part" / "model.gltf"
    assert np.allclose(trimesh.load(mesh).extents, 1)


@pytest.mark.parametrize(
    ("members", "match"),
    [
        ({"a.txt": b""}, r"^a\.zip: no mesh"),
        ({"a.ply": b"", "b.stl": b""}, r"^a\.zip: several meshes: a\.ply, b\.stl"),
        ({"../a.ply": b"x"}, "outside the archive"),
        ({"/a.ply": b"x"}, "outside the archive"),
        ({"a.ply": b"x", "..\\b.png": b"x"}, "outside the archive"),
    ],
)
def test_unpack_refuses(tmp_path, members, match):
    archive = pack(tmp_path / "a.zip", members)
    with pytest.raises(InvalidInputError, match=match):
        unpack(archive, tmp_path / "unpacked", "a.zip")
    assert list(tmp_path.iterdir()) == [archive]


def test_unpack_refuses_what_is_too_large_or_damaged(tmp_path, monkeypatch):
    archive = pack(tmp_path / "a.zip", {"a.ply": b"0" * 5000})
    content = archive.read_bytes()
    archive.write_bytes(content[:40])
    with pytest.raises(InvalidInputError, match=r"^a\.zip: the archive cannot be unpacked"):
        unpack(archive, tmp_path / "unpacked", "a.zip")
    archive.write_bytes(content.replace(struct.pack("<I", 5000), struct.pack("<I", 10)))  # a header that lies
    with pytest.raises(InvalidInputError, match="cannot be unpacked"):
        unpack(archive, tmp_path / "unpacked", "a.zip")
    archive.write_bytes(content)
    monkeypatch.setattr(uploads, "MAX_MESH_BYTES", 4999)
    with pytest.raises(InvalidInputError, match="5,000 bytes when unpacked"):
        unpack(archive, tmp_path / "unpacked", "a.zip")
    monkeypatch.setattr(uploads, "MAX_ARCHIVE_FILES", 0)
    with pytest.raises(InvalidInputError, match="1 files, more than 0"):
        unpack(archive, tmp_path / "unpacked", "a.zip")
    assert not (tmp_path / "unpacked").exists()
