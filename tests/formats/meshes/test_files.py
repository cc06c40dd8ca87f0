import pytest
import trimesh

from curvireg_torch.errors import MeshError
from curvireg_torch.formats.meshes.files import mesh_digest, mesh_files
from curvireg_torch.mesh import load_mesh
from tests.formats.meshes.pictures import encoded, noise
from tests.formats.meshes.test_gltf import textured
from tests.formats.meshes.test_ply import UV, header

EXPECTED = {suffix: {f"part.{suffix}"} for suffix in ("gltf", "obj", "ply", "glb", "stl", "off")}
EXPECTED["gltf"] |= {"picture.png", "points.bin"}
EXPECTED["obj"] |= {"part.mtl", "picture.png"}
EXPECTED["ply"] |= {"picture.png"}


def write(folder, suffix):
    """A mesh of one format with companion files."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "picture.png").write_bytes(encoded(noise()))
    (folder / "beside.png").write_bytes(b"no part of the mesh")
    path = folder / f"part.{suffix}"
    if suffix == "gltf":
        tree = textured({})
        tree.content["images"] = [{"uri": "picture.png"}]
        (folder / "points.bin").write_bytes(tree.data)
        tree.write(path, "points.bin")
    elif suffix == "obj":
        (folder / "part.mtl").write_text("newmtl skin\nmap_Kd picture.png\n")
        points = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
        path.write_text(f"mtllib part.mtl\n{points}usemtl skin\nf 1/1 2/2 3/3\n")
    elif suffix == "ply":
        text = header(UV, points=3, count=1, comments="comment TextureFile picture.png\n")
        path.write_text(text + "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n")
    else:
        trimesh.creation.box().export(path)
    return path


@pytest.mark.parametrize("suffix", EXPECTED)
def test_mesh_files_and_mesh_digest_cover_every_file_that_is_read(tmp_path, suffix):
    path = write(tmp_path, suffix)
    load_mesh(path)
    assert {file.name for file in mesh_files(path)} == EXPECTED[suffix]
    before = mesh_digest(path)
    assert mesh_digest(write(tmp_path / "copy", suffix)) == before, (
        "the digest is of the content, not of the folder"
    )
    (tmp_path / "beside.png").write_bytes(b"something else")
    assert mesh_digest(path) == before
    for name in EXPECTED[suffix]:
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content + b"\n")
        assert mesh_digest(path) != before, name
        (tmp_path / name).unlink()
        assert tmp_path / name in mesh_files(path)
        assert mesh_digest(path) != before, name
        (tmp_path / name).write_bytes(content)
    assert mesh_digest(path) == before


STARTS = {
    b"version https://git-lfs.github.com/spec/v1\nsize 1\n": "Git LFS, not the file; run git lfs",
    b"\x1f\x8b\x08\0": "packed by gzip; unpack it",
    b"\n<!DOCTYPE HTML><title>": "a web page; fetch the file itself",
}


@pytest.mark.parametrize("suffix", ["obj", "stl", "glb", "ply", "3mf"])
@pytest.mark.parametrize(("start", "words"), STARTS.items())
def test_what_a_download_leaves_in_place_of_a_mesh_is_named(refused, suffix, start, words):
    refused(f"a.{suffix}", start, words)


@pytest.mark.parametrize(("kind", "name"), [("ply", "a.obj"), ("glb", "b.stl")])
def test_a_mesh_under_the_name_of_another_kind_is_named(refused, kind, name):
    content = trimesh.creation.box().export(file_type=kind)
    refused(name, content, rf"of another kind than its name says; name it \.{kind}")


def test_mesh_digest_accepts_damaged_meshes_and_banks(tmp_path):
    path = write(tmp_path / "inside", "gltf")
    path.write_text("{")
    with pytest.raises(MeshError):
        load_mesh(path)
    assert mesh_files(path) == [path]
    assert mesh_digest(path) != mesh_digest(tmp_path / "inside" / "missing.gltf")
    (tmp_path / "secret.mtl").write_text("newmtl skin\n")
    path = tmp_path / "inside" / "part.obj"
    path.write_text("mtllib ../secret.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl skin\nf 1 2 3\n")
    assert mesh_files(path) == [path]
    bank = tmp_path / "part.safetensors"  # a list may name banks in place of meshes
    bank.write_bytes(b"a bank")
    assert mesh_files(bank) == [bank]
