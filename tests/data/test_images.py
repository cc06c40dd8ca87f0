import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from curvireg_torch.data import read_image, read_photo
from curvireg_torch.data.image_headers import read_header
from curvireg_torch.errors import ImageError, InvalidInputError, MissingFileError
from tests._support.exif import exif, with_exif
from tests._support.miniature import write_image


def test_read_image_returns_rgb_floats_in_0_to_1(tmp_path):
    bgr = np.zeros((4, 6, 3), np.uint8)
    bgr[..., 0], bgr[1, 2, 2] = 51, 255  # blue everywhere, red at x = 2, y = 1
    cv2.imwrite(str(tmp_path / "a.png"), bgr)
    image = read_image(tmp_path / "a.png")
    assert image.shape == (3, 4, 6)
    assert image.dtype == torch.float32
    assert image.is_contiguous()
    assert image[0, 1, 2] == 1
    torch.testing.assert_close(image[2], torch.full((4, 6), 0.2))


@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 255), (np.uint16, 65535)])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_read_image_reads_grey_alpha_and_16_bits(tmp_path, dtype, top, channels):
    pixels = np.full((5, 7, channels), top // 5, dtype)
    pixels[0, 0] = top
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    image = read_image(str(tmp_path / "a.png"))
    assert image.shape == (3, 5, 7)
    assert image.max() == 1
    torch.testing.assert_close(image[:, 1:], torch.full((3, 4, 7), 0.2))
    cv2.imwrite(str(tmp_path / "b.png"), np.arange(256, dtype=np.uint16).reshape(16, 16))
    assert len(read_image(tmp_path / "b.png").unique()) == 256


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_read_photo_applies_the_exif_orientation(tmp_path, suffix, orientation):
    path = tmp_path / f"a{suffix}"
    write_image(path, (20, 30))
    stored = read_image(path)
    with_exif(path, exif(orientation, order="><"[orientation % 2]))
    shown = torch.from_numpy(cv2.imread(str(path))[..., ::-1].copy()).permute(2, 0, 1)  # OpenCV honours the tag
    photo = read_photo(path)
    assert torch.equal(photo.image, shown)
    assert photo.orientation == orientation
    assert photo.notes == ((f"EXIF orientation {orientation} applied",) if orientation > 1 else ())
    assert torch.equal(read_image(path), stored)
    assert torch.equal(read_image(path, orientation="viewed"), shown.float() / 255)
    assert photo.facts()["width"] == shown.shape[2]


@pytest.mark.parametrize(("dtype", "shape"), [(np.uint8, (20, 30, 3)), (np.uint16, (20, 30))])
def test_read_image_applies_the_orientation_of_tiff_on_request(tmp_path, dtype, shape):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    for name, tags in (("plain.tif", {}), ("rotated.tif", {274: 6})):
        Image.fromarray(pixels).save(tmp_path / name, tiffinfo=tags)
    stored = read_image(tmp_path / "plain.tif")
    assert torch.equal(read_image(tmp_path / "rotated.tif"), stored)
    assert torch.equal(read_image(tmp_path / "rotated.tif", orientation="viewed"), stored.flip(1).transpose(1, 2))


def test_guessed_camera_matrix_uses_the_exif_focal_length(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path, (30, 40))
    assert read_photo(path).guessed_camera_matrix() is None
    with_exif(path, exif(6, focal=27))
    photo = read_photo(path)
    assert photo.focal_35mm == photo.facts()["focal_35mm"] == 27
    K = photo.guessed_camera_matrix()
    # The diagonal of 50 px corresponds to 43.27 mm on a 36 x 24 mm film; the rotated picture is 30 px wide.
    assert float(K[0, 0]) == float(K[1, 1]) == pytest.approx(27 * 50 / 43.2666, rel=1e-5)
    assert K[:2, 2].tolist() == [14.5, 19.5]


def test_read_photo_ignores_damaged_exif(tmp_path):
    path = tmp_path / "a.jpg"
    write_image(path)
    whole = exif(6, focal=27)
    plain = path.read_bytes()
    for block in [whole[:n] for n in range(len(whole))] + [exif(0), exif(9), b"XX" + whole[2:]]:
        path.write_bytes(plain)
        with_exif(path, block)
        assert read_photo(path).image.shape in ((3, 60, 80), (3, 80, 60))
    assert read_photo(path).orientation == 1


def test_read_image_returns_uint8_on_request(tmp_path):
    write_image(tmp_path / "a.png")
    assert torch.equal(read_image(tmp_path / "a.png", dtype=torch.uint8).float() / 255, read_image(tmp_path / "a.png"))
    cv2.imwrite(str(tmp_path / "b.png"), np.array([[0, 128, 129, 65535]], np.uint16))
    assert read_image(tmp_path / "b.png", dtype=torch.uint8)[0].tolist() == [[0, 0, 1, 255]]
    with pytest.raises(InvalidInputError, match="float16"):
        read_image(tmp_path / "a.png", dtype=torch.float16)


def test_read_photo_notes_changes_of_channels(tmp_path):
    notes = {1: ("grey: three equal channels",), 3: (), 4: ("alpha channel dropped",)}
    for name, channels in {"png": (1, 4), "webp": (3, 4), "tiff": (1,), "bmp": (3,), "pgm": (1,)}.items():
        for count in channels:
            assert cv2.imwrite(str(tmp_path / f"a.{name}"), np.full((4, 4, count), 9, np.uint8))
            assert read_photo(tmp_path / f"a.{name}").notes == notes[count], name
    assert cv2.imwrite(str(tmp_path / "deep.png"), np.full((4, 4, 3), 9, np.uint16))
    assert read_photo(tmp_path / "deep.png").notes == ("16 bits rounded to 8",)


@pytest.mark.parametrize("name", ["a.jpg", "a.tif"])
def test_read_photo_converts_cmyk(tmp_path, name):
    Image.new("RGB", (8, 8), (250, 10, 30)).convert("CMYK").save(tmp_path / name, quality=95)
    photo = read_photo(tmp_path / name)
    assert photo.notes == ("CMYK converted to RGB without a colour profile",)
    assert (photo.image[:, 4, 4].int() - torch.tensor([250, 10, 30])).abs().max() <= 4


def test_read_photo_refuses_cielab_and_floating_pixels(tmp_path):
    Image.new("LAB", (8, 8), (120, 10, 30)).save(tmp_path / "a.tif")
    assert cv2.imwrite(str(tmp_path / "b.tif"), np.ones((4, 4, 3), np.float32))
    for name, match in (("a.tif", "CIELAB"), ("b.tif", "float32")):
        with pytest.raises(ImageError, match=match):
            read_photo(tmp_path / name)


OTHERS = {b"heic": "HEIC", b"mif1": "HEIC", b"avif": "AVIF", b"isom": "video"}
OTHERS = {b"\0\0\0\x18ftyp" + brand: name for brand, name in OTHERS.items()} | {b"GIF89a": "GIF", b"%PDF-1.4": "PDF"}


@pytest.mark.parametrize(("content", "name"), OTHERS.items())
def test_read_photo_names_other_formats(tmp_path, content, name):
    (tmp_path / "a.jpg").write_bytes(content + bytes(100))
    with pytest.raises(ImageError, match=rf"a\.jpg: .*{name}.*convert it"):
        read_photo(tmp_path / "a.jpg")


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_read_image_refuses_truncated_files(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_image(path, (64, 64))
    data = path.read_bytes()
    for fraction in (0.02, 0.5, 0.9):
        path.write_bytes(data[: int(len(data) * fraction)])
        with pytest.raises(ImageError, match=r"truncated|not an image"):
            read_image(path)


def test_read_photo_ignores_bytes_after_the_picture(tmp_path):
    for suffix in (".jpg", ".png"):
        write_image(tmp_path / f"a{suffix}")
        with open(tmp_path / f"a{suffix}", "ab") as file:
            file.write(b"\n\n" + bytes(range(256)) * 8 + b"\xff\xda")  # as a motion photo, which may hold any marker
        photo = read_photo(tmp_path / f"a{suffix}")
        assert photo.image.shape == (3, 60, 80)
        assert photo.notes == ("2,052 bytes after the picture ignored",)


def test_read_header_skips_segments_before_the_frame_of_a_jpeg(tmp_path):
    write_image(tmp_path / "a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    arithmetic = b"\xff\xcc\0\x09\x08\0\x07\0\x09\x03\0"  # as a frame it would be 9 x 7 px
    for more in (b"\xff\x01", b"\xff\xd8", arithmetic):
        header = read_header(data[:2] + more + data[2:])
        assert (header.width, header.height, header.scans) == (80, 60, 1)


@pytest.mark.parametrize("content", [b"", b"no image at all", b"\xff\xd8\xff\xd9", b"\x89PNG\r\n\x1a\nIEND"])
def test_read_image_refuses_other_content(tmp_path, content):
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(ImageError, match=r"a\.jpg"):
        read_image(tmp_path / "a.jpg")


def test_read_image_reports_missing_files(tmp_path):
    for path in (tmp_path / "nothing.jpg", tmp_path):
        with pytest.raises(MissingFileError, match="no such file; check the path of the photograph"):
            read_image(path)
