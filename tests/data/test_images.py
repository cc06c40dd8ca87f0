import math
import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from curvireg_torch.data import images, read_image, read_photo
from curvireg_torch.errors import ImageError, MissingFileError
from curvireg_torch.formats import pictures
from tests._support import refused
from tests._support.exif import exif, png_chunk, with_exif
from tests._support.miniature import write_image


def photo_of(path, content):
    """The photograph of a file with these bytes, or these pixels as OpenCV has them."""
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        assert cv2.imwrite(str(path), content)
    return read_photo(path)


@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 255), (np.uint16, 65535)])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_read_image_returns_rgb_floats_in_0_to_1_of_grey_alpha_and_16_bits(
    tmp_path, dtype, top, channels
):
    pixels = np.full((5, 7, channels), top // 5, dtype)
    pixels[0, 2, 2 % channels] = top  # red, as OpenCV counts from blue
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    image = read_image(str(tmp_path / "a.png"))
    assert (image.shape, image.dtype, image.is_contiguous()) == ((3, 5, 7), torch.float32, True)
    assert_close(image[:, 0, 2], torch.tensor([1.0, *[1.0 if channels == 1 else 0.2] * 2]))
    assert_close(image[:, 1:], torch.full((3, 4, 7), 0.2))


def test_read_photo_scales_by_the_largest_value_of_pgm(tmp_path):
    for content in (
        b"P5 3 1 4095\n" + np.array([0, 819, 4095], ">u2").tobytes(),  # 12 bits
        b"P5 3 1 100\n" + bytes([0, 20, 100]),
        b"P2 3 1 10 0 2 10\n",
        b"P6 1 1 4095\n" + np.array([0, 819, 4095], ">u2").tobytes(),  # one pixel in colour
    ):
        image = photo_of(tmp_path / "a.pgm", content).image
        assert (image[:, 0, 0] if content[:2] == b"P6" else image[0, 0]).tolist() == [0, 51, 255]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_read_photo_inverts_tiff_in_which_white_is_zero(tmp_path, dtype):
    top = np.iinfo(dtype).max
    path = tmp_path / "a.tif"
    Image.fromarray(np.array([[0, top // 5, top]], dtype)).save(path)
    assert read_photo(path).image[0].tolist() == [[0, 51, 255]]
    data = path.read_bytes()
    black, white = (struct.pack("<HHIHH", 262, 3, 1, value, 0) for value in (1, 0))
    assert data.count(black) == 1
    assert photo_of(path, data.replace(black, white)).image[0].tolist() == [[255, 204, 0]]


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_read_photo_applies_the_exif_orientation(tmp_path, suffix, orientation):
    path = tmp_path / f"a{suffix}"
    write_image(path, (20, 30))
    stored = read_image(path)
    with_exif(path, exif(orientation, order="><"[orientation % 2]))
    # OpenCV honours the tag
    shown = torch.from_numpy(cv2.imread(str(path))[..., ::-1].copy()).permute(2, 0, 1)
    photo = read_photo(path)
    assert torch.equal(photo.image, shown)
    assert photo.orientation == orientation
    assert photo.notes == ((f"EXIF orientation {orientation} applied",) if orientation > 1 else ())
    assert torch.equal(read_image(path), stored)
    assert photo.facts()["width"] == shown.shape[2]


@pytest.mark.parametrize(("dtype", "shape"), [(np.uint8, (20, 30, 3)), (np.uint16, (20, 30))])
def test_read_image_applies_the_orientation_of_tiff_on_request(tmp_path, dtype, shape):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    plain = tmp_path / "plain.tif"
    rotated = tmp_path / "rotated.tif"
    for path, tags in ((plain, {}), (rotated, {274: 6})):
        Image.fromarray(pixels).save(path, tiffinfo=tags)
    stored = read_image(plain)
    assert torch.equal(read_image(rotated), stored)
    assert torch.equal(read_photo(rotated).image / 255, stored.flip(1).transpose(1, 2))


def test_guessed_camera_matrix_uses_the_exif_focal_length(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path, (30, 40))
    assert read_photo(path).guessed_camera_matrix() is None
    with_exif(path, exif(6, focal=27))
    photo = read_photo(path)
    assert photo.focal_35mm == photo.facts()["focal_35mm"] == 27
    K = photo.guessed_camera_matrix()
    # The diagonal of 50 px corresponds to 43.27 mm on a 36 x 24 mm film; the rotated picture is 30
    # px wide.
    assert float(K[0, 0]) == float(K[1, 1]) == pytest.approx(27 * 50 / 43.2666, rel=1e-5)
    assert K[:2, 2].tolist() == [14.5, 19.5]


def photo_with(path, tags, size=(648, 432), orientation=1, **how):
    """A photograph with EXIF data of a camera."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", size).save(path, exif=exif, **how)
    return read_photo(path)


def photo_of_eos(folder, tags):
    """A photograph of that camera, whose ``tags`` are others."""
    return photo_with(folder / "a.jpg", {0xA210: 2} | EOS | tags)


EOS = {0x920A: 50.0, 0xA20E: 5184 / 0.894, 0xA20F: 3456 / 0.596, 0xA002: 5184, 0xA003: 3456}
"""EXIF data of a camera with a sensor of 22.7 x 15.1 mm and a lens of 50 mm."""


@pytest.mark.parametrize(
    ("tags", "focal_35mm"),
    [
        ({}, 79.3),
        ({0xA210: 3, 0xA20E: 5184 / 2.27, 0xA20F: 3456 / 1.514}, 79.3),  # in cm
        ({0xA210: 4, 0xA20E: 5184 / 22.7, 0xA20F: 3456 / 15.14}, 79.3),  # in mm
        ({0xA405: 80}, 80.0),  # what the camera states goes first
        ({0xA20F: 2 * 3456 / 0.596}, None),  # pixels that are not square
        ({0xA20E: 300.0, 0xA20F: 300.0}, None),  # that of a print: a sensor of half a metre
        ({0xA210: 1}, None),  # no unit
        ({0x920A: 0.0}, None),
    ],
)
def test_the_size_of_the_sensor_gives_the_focal_length(tmp_path, tags, focal_35mm):
    photo = photo_of_eos(tmp_path, tags)
    if focal_35mm is None:
        assert photo.focal_35mm is photo.camera() is None
        return
    assert photo.focal_35mm == pytest.approx(focal_35mm, rel=2e-3)
    if 0xA405 not in tags:  # 50 mm of 22.7 mm in width
        assert float(photo.camera().matrix[0, 0]) == pytest.approx(648 * 50 / 22.7, rel=5e-3)
        assert photo.camera().source == "exif"


@pytest.mark.parametrize(
    ("tags", "zoom", "focal", "deviation"),
    [
        ({}, 1.0, 79.3, 0.05),
        ({0xA404: 2.0}, 1.0, 2 * 79.3, 0.05),  # the size of the sensor gave the focal length
        ({0xA404: 2.0, 0xA405: 40}, 2.0, 40 * 2**0.5, 0.35),  # which the camera may have included
        ({0xA404: 1.5, 0xA405: 40}, 1.5, 40 * 1.5**0.5, 0.21),
        ({0xA404: 1.0, 0xA405: 40}, 1.0, 40.0, 0.05),
        ({0xA404: 0.0, 0xA405: 40}, 1.0, 40.0, 0.05),  # not used, as EXIF says
        ({0xA404: 1000.0, 0xA405: 40}, 1.0, 40.0, 0.05),
        ({0xA404: 2.0, 0xA405: 0, 0xA20E: 1.0, 0xA20F: 1.0}, 1.0, None, None),
    ],
)
def test_a_digital_zoom_counts_or_makes_the_focal_length_uncertain(
    tmp_path, tags, zoom, focal, deviation
):
    photo = photo_of_eos(tmp_path, tags)
    assert photo.digital_zoom == zoom
    assert any("perhaps not in the focal" in note for note in photo.notes) == (zoom > 1)
    camera = photo.camera()
    if focal is None:
        assert camera is None
        return
    diagonal = (648**2 + 432**2) ** 0.5
    assert float(camera.matrix[0, 0]) == pytest.approx(focal * diagonal / 43.27, rel=5e-3)
    assert camera.focal_deviation == pytest.approx(deviation, abs=0.005)


def test_panoramas_have_no_pinhole_camera(tmp_path):
    tags = {0xA405: 26}
    xmp = b'<x:xmpmeta><rdf:Description GPano:ProjectionType="cylindrical"/></x:xmpmeta>'
    for name, size, words, is_panorama in (
        ("a.jpg", (640, 480), xmp, True),
        ("a.webp", (640, 480), xmp, True),
        ("b.jpg", (640, 480), xmp.replace(b"GPano", b"Other"), False),
        ("c.jpg", (640, 256), b"", False),
        ("d.jpg", (641, 256), b"", True),
        ("e.jpg", (256, 641), b"", True),
        ("f.jpg", (640, 270), b"", False),  # 21 : 9
    ):
        photo = photo_with(tmp_path / name, tags, size, xmp=words)
        assert photo.is_panorama == is_panorama
        assert (photo.camera() is None) == is_panorama
    Image.new("RGB", (641, 256)).save(tmp_path / "g.png")  # of whatever camera
    assert not read_photo(tmp_path / "g.png").is_panorama
    tags |= {0xA002: 800, 0xA003: 600}  # cut out of a picture
    assert not photo_with(tmp_path / "h.jpg", tags, (641, 200)).is_panorama


def test_read_photo_rounds_16_bits_converts_cmyk_and_notes_changes_of_channels(tmp_path):
    deep = photo_of(tmp_path / "b.png", np.array([[0, 128, 129, 65535]], np.uint16))
    assert deep.image[0].tolist() == [[0, 0, 1, 255]]
    notes = {1: ("grey: three equal channels",), 3: (), 4: ("alpha channel dropped",)}
    for name in ("1.png", "4.png", "3.webp", "4.webp", "1.tiff", "3.bmp", "1.pgm"):
        count = int(name[0])
        photo = photo_of(tmp_path / name, np.full((4, 4, count), 9, np.uint8))
        assert photo.notes == notes[count], name
    colour = Image.new("RGB", (8, 8))  # phones add previews to photographs
    colour.save(tmp_path / "phone.jpg", format="MPO", save_all=True, append_images=[colour])
    assert read_photo(tmp_path / "phone.jpg").notes == ()
    for name in ("a.jpg", "a.tif"):
        Image.new("RGB", (8, 8), (250, 10, 30)).convert("CMYK").save(tmp_path / name, quality=95)
        photo = read_photo(tmp_path / name)
        assert photo.notes == ("CMYK converted to RGB without a colour profile",)
        assert (photo.image[:, 4, 4].int() - torch.tensor([250, 10, 30])).abs().max() <= 4


def test_read_photo_refuses_cielab_floating_pixels_and_other_formats(tmp_path):
    Image.new("LAB", (8, 8), (120, 10, 30)).save(tmp_path / "a.tif")
    assert cv2.imwrite(str(tmp_path / "b.tif"), np.ones((4, 4, 3), np.float32))
    Image.fromarray(np.ones((4, 4), np.int32)).save(tmp_path / "c.tif")
    Image.new("L", (4, 4)).save(tmp_path / "d.gif")
    expected = {
        "a.tif": "CIELAB",
        "b.tif": "convert",
        "c.tif": "32 bits",
        "d.gif": "JPEG, PNG, TIFF",
    }
    for name, match in expected.items():
        with refused(rf"{name}: .*{match}", ImageError):
            read_photo(tmp_path / name)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_read_image_refuses_truncated_other_and_missing_files(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_image(path, (64, 64))
    data = path.read_bytes()
    others = (b"", b"no image at all", b"\xff\xd8\xff\xd9", b"\x89PNG\r\n\x1a\nIEND")
    for content in (*(data[: int(len(data) * fraction)] for fraction in (0.02, 0.5, 0.9)), *others):
        path.write_bytes(content)
        with refused(r"a\.\w+: (damaged or truncated|not an image)", ImageError):
            read_image(path)
    with refused(r"a\.\w+: a web page", ImageError):
        photo_of(path, b"<html><body>Not found")
    for path in (tmp_path / "nothing.jpg", tmp_path):
        with refused("no such file; check the path of the photograph", MissingFileError):
            read_image(path)


def test_read_photo_counts_pixels_before_it_decodes(tmp_path):
    """Small files of huge pictures."""
    side = 20_000
    bmp = b"BM" + bytes(12) + struct.pack("<IiiHHI", 40, side, -side, 1, 24, 0) + bytes(20)
    packer = zlib.compressobj(9)
    body = b"".join(packer.compress(bytes(1 + side // 8)) for _ in range(side)) + packer.flush()
    png = b"\x89PNG\r\n\x1a\n"
    png += png_chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0))
    png += png_chunk(b"IDAT", body) + png_chunk(b"IEND", b"")
    for name, content in (("a.bmp", bmp), ("a.png", png)):
        (tmp_path / name).write_bytes(content)
        tracemalloc.start()
        with refused(rf"{name}: more than 89,478,485 pixels; scale it down", ImageError):
            read_photo(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 20e6
        tracemalloc.stop()


def test_read_photo_bounds_bytes(tmp_path, monkeypatch):
    """Before the file is read."""
    path = tmp_path / "a.jpg"
    Image.new("RGB", (64, 64), (200, 100, 50)).save(path)
    monkeypatch.setattr(pictures, "MAX_IMAGE_BYTES", 100)
    with refused("larger than 100 bytes", ImageError):
        read_photo(path)


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
def test_read_photo_keeps_the_orientation_if_the_rest_of_exif_is_damaged(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path)
    plain = path.read_bytes()
    whole = exif(6, focal=27)
    ends = (b"", whole[38:41], b"\xff" * 18)
    damaged = [*(whole[:38] + end for end in ends), whole[:30] + b"\xff" * 4 + whole[34:]]
    for block in (*damaged, exif(0), exif(9), b"XX" + whole[2:], whole[:20], b""):
        path.write_bytes(plain)
        with_exif(path, block)
        photo = read_photo(path)
        assert (photo.orientation, photo.focal_35mm) == (6 if block in damaged else 1, None)


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
@pytest.mark.parametrize("channels", [1, 3])
def test_few_bits_in_sixteen_are_stretched(tmp_path, bits, channels):
    pixels = np.random.default_rng(bits).integers(0, 2**bits, (6, 8, channels)).astype(np.uint16)
    pixels[0, 0] = 2**bits - 1
    photo = photo_of(tmp_path / "camera.png", pixels)
    shown = photo.image.movedim(0, -1).numpy()
    assert np.abs(shown - pixels[..., ::-1] * 255.0 / (2**bits - 1)).max() <= 0.5 + 1e-9
    assert f"16 bits, of which the lower {bits} are used: stretched" in photo.notes


def test_sixteen_bits_that_are_used_are_not_stretched(tmp_path):
    pixels = np.full((4, 4), 2**14, np.uint16)
    photo = photo_of(tmp_path / "a.png", pixels)
    assert int(photo.image.max()) == 64
    assert photo.notes == ("grey: three equal channels",)
    assert photo_of(tmp_path / "black.png", 0 * pixels).notes == photo.notes
    colours = np.random.default_rng(0).integers(0, 4096, (9, 9, 3)).astype(np.uint16)
    (note,) = photo_of(tmp_path / "colour.tif", colours).notes
    assert note == "16 bits, of which the lower ones are used: 16 levels remain; save it as PNG"


@pytest.mark.parametrize("count", [1, 2, pictures.MAX_THUMBNAILS - 1])
def test_thumbnails_before_the_picture_of_a_tiff_are_passed_over(tmp_path, count):
    path = tmp_path / "a.tif"
    thumbnail = {254: 1}

    def photo_after(size, tags):
        """Of ``count`` thumbnails and a last page."""
        pages = [Image.new("L", (4, 4), 10 * page) for page in range(count)]
        for page in pages:
            page.encoderinfo = {"tiffinfo": thumbnail}
        last = Image.new("L", size, 200)
        last.encoderinfo = {"tiffinfo": tags}
        pages[0].save(path, tiffinfo=thumbnail, save_all=True, append_images=[*pages[1:], last])
        return read_photo(path)

    assert photo_after((8, 6), {}).image.shape == (3, 6, 8)
    with refused("holds thumbnails only", ImageError):
        photo_after((4, 4), thumbnail)


def test_a_dark_pgm_is_not_stretched_as_it_names_its_largest_value(tmp_path):
    content = b"P5 2 1 65535\n" + np.array([0, 2570], ">u2").tobytes()
    photo = photo_of(tmp_path / "a.pgm", content)
    assert photo.image[0, 0].tolist() == [0, 10]
    assert photo.notes == ("grey: three equal channels",)


def test_exif_camera_respects_crops_and_pictures_of_pillow(tmp_path):
    tags = {0xA405: 26, 0xA002: 400, 0xA003: 300}
    diagonal = math.hypot(36.0, 24.0)
    for size, focal in (
        ((400, 300), 500.0),
        ((200, 150), 250.0),
        ((200, 200), 500.0),
        ((500, 300), None),
        ((390, 350), None),  # higher than the picture that the camera took
        ((202, 150), math.hypot(202, 150)),  # resized: a side of 150 px is one of 149.5 to 150.5
        ((204, 150), 500.0),  # cut out
    ):
        path = tmp_path / "photo.jpg"
        photo = photo_with(path, tags, size, orientation=6)  # turned by a quarter
        with Image.open(path) as picture:
            same = images.photo_of_picture(picture)
        assert tuple(photo.image.shape[1:]) == tuple(same.image.shape[1:]) == size
        camera = photo.camera()
        if focal is None:
            assert camera is same.camera() is None, "larger than what the camera took"
            continue
        assert float(camera.matrix[0, 0]) == pytest.approx(26 * focal / diagonal)
        assert torch.equal(camera.matrix, same.camera().matrix)
        assert (camera.source, camera.focal_deviation) == ("exif", 0.05)
        assert camera.matrix[:2, 2].tolist() == [(side - 1) / 2 for side in size[::-1]]


def test_palettes_with_several_transparent_colours(tmp_path, recwarn):
    pixels = np.zeros((8, 8, 4), np.uint8)
    pixels[:4] = (200, 30, 60, 255)
    pixels[4:, :4] = (10, 220, 100, 0)
    pixels[4:, 4:] = (10, 20, 200, 128)
    Image.fromarray(pixels).quantize(8).save(tmp_path / "a.png")
    photo = read_photo(tmp_path / "a.png")
    assert photo.image[:, 0, 0].tolist() == [200, 30, 60]
    assert photo.image[:, 7, 7].tolist() == [10, 20, 200]
    assert "alpha channel dropped" in photo.notes
    assert not recwarn.list
