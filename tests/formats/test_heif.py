"""HEIC and AVIF: photographs of telephones."""

import sys

import numpy as np
import pytest
from PIL import Image, features

from curvireg_torch.data import read_image, read_photo
from curvireg_torch.errors import ImageError, MissingDependencyError
from curvireg_torch.formats.heif import heif_kind
from tests._support.exif import exif
from tests._support.refusals import refused


@pytest.fixture
def picture():
    """(48, 64, 3): red on the left, blue on the right, a white bar on top."""
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:, :32, 0] = 200
    pixels[:, 32:, 2] = 200
    pixels[:8] = 255
    return pixels


@pytest.fixture
def written(tmp_path, picture):
    """Write the picture as HEIC, perhaps with EXIF; returns its path."""
    encoder = pytest.importorskip("pillow_heif")
    pytest.importorskip("pi_heif")

    def write(name="photo.HEIC", **options):
        file = encoder.from_bytes("RGB", (64, 48), picture.tobytes())
        file.save(tmp_path / name, quality=95, **options)
        return tmp_path / name

    return write


def close(image, pixels):
    return np.abs(image.movedim(0, -1).numpy().astype(float) - pixels).mean() < 8.0


def test_heic_is_read_with_its_focal_length_and_its_own_orientation(written, picture):
    photo = read_photo(written(exif=exif(1, 26)))
    assert close(photo.image, picture)
    assert photo.focal_35mm == 26.0
    assert photo.orientation == 1
    turned = written("turned.heic", exif=exif(6, 26))  # a property of the file, as telephones write
    photo = read_photo(turned)
    assert close(photo.image, np.rot90(picture, -1))
    assert photo.focal_35mm == 26.0
    assert read_image(turned).shape == photo.image.shape


def test_heic_is_bounded_by_its_header(written, monkeypatch):
    file = written()
    monkeypatch.setattr("curvireg_torch.utils.pictures.MAX_IMAGE_PIXELS", 48 * 64)
    read_photo(file)
    monkeypatch.setattr("curvireg_torch.utils.pictures.MAX_IMAGE_PIXELS", 48 * 64 - 1)
    with refused("pixels; scale it down", ImageError):
        read_photo(file)


def test_damaged_heic_is_refused_in_one_line(written, tmp_path, write):
    data = written().read_bytes()
    for cut in (40, len(data) // 2, len(data) - 100):
        write("cut.heic", data[:cut])
        with refused(r"cut\.heic: damaged or truncated", ImageError) as error:
            read_photo(tmp_path / "cut.heic")
        assert "\n" not in str(error.value)


def test_a_missing_decoder_is_named_with_the_command_that_installs_it(tmp_path, write, monkeypatch):
    write("a.heic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + b"\0" * 99)
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    with refused(r"a\.heic: HEIC needs pi-heif: pip install .*heic", MissingDependencyError):
        read_photo(tmp_path / "a.heic")
    monkeypatch.setattr(features, "check", lambda _: False)
    write("a.avif", b"\0\0\0\x18ftypavif\0\0\0\0mif1miaf" + b"\0" * 99)
    with refused(r"a\.avif: AVIF needs Pillow 11\.3", MissingDependencyError):
        read_photo(tmp_path / "a.avif")


def test_kinds_are_told_by_the_brands_of_the_first_box():
    assert heif_kind(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic") == "HEIC"
    assert heif_kind(b"\0\0\0\x1cftypmif1\0\0\0\0mif1avifmiaf") == "AVIF"
    assert heif_kind(b"\0\0\0\x1cftypmif1\0\0\0\0mif1heicmiaf") == "HEIC"
    assert heif_kind(b"\0\0\0\x10ftypisom\0\0\0\0heic") is None  # beyond the box
    assert heif_kind(b"\0\0\0\x18ftypisom\0\0\0\0isomavc1") is None
    assert heif_kind(b"\xff\xd8\xff\xe0") is None


@pytest.mark.skipif(not features.check("avif"), reason="Pillow has no AVIF")
def test_avif_is_read_with_its_orientation(tmp_path, picture):
    Image.fromarray(picture).save(tmp_path / "a.avif", quality=95, exif=exif(6, 26))
    photo = read_photo(tmp_path / "a.avif")
    assert close(photo.image, np.rot90(picture, -1))
    assert photo.focal_35mm == 26.0
