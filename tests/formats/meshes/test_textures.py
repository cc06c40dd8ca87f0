"""Textures of unknown origin: which formats are decoded, and how much of them."""

import base64
from io import BytesIO

import numpy as np
import pytest
import trimesh
from PIL import Image

import curvireg_torch as cr
from curvireg_torch.formats.meshes import colours, source
from curvireg_torch.mesh import as_mesh
from tests._support.quick import slow_after
from tests.formats.meshes.pictures import encoded, noise
from tests.formats.meshes.test_files import write as write_mesh

POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n%%EOF\n"
FORMATS = dict.fromkeys(("JPEG", "PNG", "TIFF", "WEBP", "BMP", "PPM"), True)
FORMATS |= dict.fromkeys(("GIF", "TGA", "PCX", "ICO", "EPS", "PDF", "SGI"), False)


def picture(kind, size=(8, 8), **how):
    if kind == "EPS":
        return POSTSCRIPT
    return encoded(np.resize(noise(), (*size[::-1], 3)), kind, **how)


def write(folder, carrier, content):
    """A mesh of one format whose texture is called picture.png, whatever it holds."""
    path = write_mesh(folder, "gltf" if carrier == "data" else carrier)
    (folder / "picture.png").write_bytes(content)
    if carrier == "data":
        uri = "data:image/png;base64," + base64.b64encode(content).decode()
        path.write_text(path.read_text().replace("picture.png", uri))
    return path


@pytest.mark.parametrize("carrier", ["obj", "ply", "gltf", "data"])
@pytest.mark.parametrize("kind", FORMATS)
def test_only_the_formats_of_photographs_are_decoded(tmp_path, load, monkeypatch, carrier, kind):
    def refuse(*words, **how):
        raise AssertionError(f"a program is started: {words} {how}")

    monkeypatch.setattr("subprocess.Popen", refuse)
    mesh, texts = load(write(tmp_path, carrier, picture(kind)))
    assert mesh.has_colours == FORMATS[kind]
    assert [warning.kind for warning in mesh.warnings] == ([] if FORMATS[kind] else ["texture"])
    assert all("not an image that is read" in text for text in texts)


def test_pictures_of_a_mesh_in_memory_are_checked_too(tmp_path, write):
    write("a.eps", POSTSCRIPT)
    mesh = trimesh.creation.box()
    with Image.open(tmp_path / "a.eps") as picture:
        mesh.visual = trimesh.visual.TextureVisuals(uv=mesh.vertices[:, :2], image=picture)
        with pytest.warns(UserWarning, match="the format EPS is not read"):
            assert as_mesh(mesh).colours is None


def test_pixels_of_all_textures_together_are_bounded(write, load, monkeypatch):
    for k in range(4):
        write(f"{k}.png", picture("PNG", (40, 25)))
    write("a.mtl", "".join(f"newmtl m{k}\nmap_Kd {k}.png\n" for k in range(4)))
    faces = "".join(f"usemtl m{k}\nf 1/1 2/1 3/1\n" for k in range(4))
    path = write("a.obj", f"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n{faces}")
    monkeypatch.setattr(source, "MAX_TEXTURE_PIXELS", 3999)
    monkeypatch.setattr(colours, "MAX_TEXTURE_PIXELS", 3999)
    mesh, texts = load(path)
    assert len(mesh.colours.textures) == 3
    (text,) = texts
    assert "3.png cannot be used (the textures have more than 3,999 pixels together)" in text
    monkeypatch.setattr(source, "MAX_TEXTURE_PIXELS", 4000)
    assert not load(path)[1]


def test_a_texture_of_many_pixels_or_scans_is_left_out(tmp_path, load, monkeypatch):
    path = write(tmp_path, "obj", picture("PNG", (200, 100)))
    monkeypatch.setattr("curvireg_torch.utils.pictures.MAX_IMAGE_PIXELS", 19_999)
    assert "pixels; scale it down" in load(path)[1][0]
    monkeypatch.undo()
    path = write(tmp_path, "obj", picture("JPEG", (64, 64), progressive=True))
    assert not load(path)[1]
    monkeypatch.setattr("curvireg_torch.utils.pictures.MAX_IMAGE_SCANS", 5)
    assert "scans, more than 5" in load(path)[1][0]
    path = write(tmp_path, "obj", picture("PNG")[:60])
    assert "picture.png cannot be used" in load(path)[1][0]


@pytest.mark.parametrize(
    "mode", slow_after(3, ["1", "P", "I;16", "L", "LA", "RGB", "RGBA", "CMYK"])
)
def test_large_textures_are_reduced_in_every_mode(mode):
    """Before they are converted to RGBA, which would take four times the memory."""
    size = (6400, 5600)
    image = (
        Image.new(mode, size, 65535) if mode == "I;16" else Image.new("L", size, 255).convert(mode)
    )
    file = BytesIO()
    image.save(file, "TIFF")
    pixels, count = colours.texture_pixels(file.getvalue(), 6400 * 5600)
    assert count == 6400 * 5600
    assert max(pixels.shape[:2]) == colours.TEXTURE_SIDE
    assert pixels.shape[0] == round(colours.TEXTURE_SIDE * 5600 / 6400)
    assert int(pixels.min()) >= 254 or mode == "CMYK"


def test_a_mesh_without_any_colour_has_none(write):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n"
    assert cr.load_mesh(write("a.obj", text)).colours is None
