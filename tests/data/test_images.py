import cv2
import numpy as np
import pytest
import torch

from curvireg_torch.data import read_image
from curvireg_torch.errors import ImageError, MissingFileError
from tests._support.miniature import write_image


def test_rgb_order_range_and_dtype(tmp_path):
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
def test_grey_alpha_and_16_bit(tmp_path, dtype, top, channels):
    pixels = np.full((5, 7, channels), top // 5, dtype)
    pixels[0, 0] = top
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    image = read_image(str(tmp_path / "a.png"))
    assert image.shape == (3, 5, 7)
    assert image.max() == 1
    torch.testing.assert_close(image[:, 1:], torch.full((3, 4, 7), 0.2))


def test_16_bit_keeps_its_precision(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.arange(256, dtype=np.uint16).reshape(16, 16))
    assert len(read_image(tmp_path / "a.png").unique()) == 256


def test_exif_orientation_is_ignored(tmp_path):
    write_image(tmp_path / "a.jpg", (20, 30))
    plain = (tmp_path / "a.jpg").read_bytes()
    tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"  # orientation 6: turn by 90 degrees
    body = b"Exif\0\0" + tiff
    turned = plain[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + plain[2:]
    (tmp_path / "b.jpg").write_bytes(turned)
    assert cv2.imread(str(tmp_path / "b.jpg")).shape[:2] == (30, 20), "the tag is one that OpenCV honours"
    assert read_image(tmp_path / "b.jpg").shape == (3, 20, 30)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("kept", [0.02, 0.5, 0.9])
def test_truncated(tmp_path, suffix, kept):
    path = tmp_path / f"a{suffix}"
    write_image(path, (64, 64))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(ImageError, match=r"truncated|not an image"):
        read_image(path)


def test_bytes_after_the_end_are_allowed(tmp_path):
    for suffix in (".jpg", ".png"):
        write_image(tmp_path / f"a{suffix}")
        with open(tmp_path / f"a{suffix}", "ab") as file:
            file.write(b"\n\n")
        assert read_image(tmp_path / f"a{suffix}").shape == (3, 60, 80)


@pytest.mark.parametrize("content", [b"", b"no image at all", b"\xff\xd8\xff\xd9", b"\x89PNG\r\n\x1a\nIEND"])
def test_not_an_image(tmp_path, content):
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(ImageError, match=r"a\.jpg"):
        read_image(tmp_path / "a.jpg")


def test_floating_pixels_are_refused(tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.tiff"), np.ones((4, 4, 3), np.float32))
    with pytest.raises(ImageError, match="float32"):
        read_image(tmp_path / "a.tiff")


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "nothing.jpg", tmp_path):
        with pytest.raises(MissingFileError, match="no such file"):
            read_image(path)
