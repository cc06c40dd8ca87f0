"""Which pictures are decoded: by their first bytes, before Pillow chooses a decoder."""

import io
import re
import shutil
import struct
from contextlib import suppress
from pathlib import Path

import pytest
from PIL import EpsImagePlugin, Image

from curvireg_torch.errors import MAX_IMAGE_PIXELS, ImageError
from curvireg_torch.utils import pictures
from curvireg_torch.utils.pictures import (
    PICTURE_NAMES,
    PICTURE_STARTS,
    open_picture,
    picture_format,
)
from tests._support import refused
from tests._support.doubling import check_linear

SECURITY = Path(__file__).parents[2] / "SECURITY.md"
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n%%EOF\n"
DOS_POSTSCRIPT = (
    b"\xc5\xd0\xd3\xc6"
    + (32).to_bytes(4, "little")
    + len(POSTSCRIPT).to_bytes(4, "little")
    + bytes(20)
)


def _saved(name, mode="RGB", **options):
    file = io.BytesIO()
    Image.new(mode, (8, 8)).save(file, name, **options)
    return file.getvalue()


def test_open_picture_opens_the_formats_of_security_md_and_no_other_that_pillow_writes():
    Image.init()
    opened = set()
    for name in Image.SAVE:
        for mode in ("RGB", "L", "P"):
            try:
                data = _saved(name, mode)
            except Exception:  # formats of other modes, or written by programs that are absent
                continue
            try:
                open_picture(data).close()
                opened.add(name)
            except ImageError:
                continue
    assert opened - {"MPO", "JPEG2000"} == set(PICTURE_STARTS)  # MPO: a JPEG with others behind it
    listed = re.search(r"those of (.*?);", SECURITY.read_text())
    assert listed is not None
    assert listed[1].replace(" or ", ", ") == PICTURE_NAMES


def test_open_picture_tells_formats_by_each_of_their_starts():
    starts = {
        "TIFF": (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
        "PPM": (b"P1\n", b"P2 ", b"P3\t", b"P4\r", b"P5\n", b"P6\n"),
        "WEBP": (b"RIFF\n\0\n\0WEBP",),
    }
    for name, kinds in starts.items():
        for start in kinds:
            assert picture_format(start + b"rest") == name
            for other in (b" " + start, start[:-1]):
                with refused("not an image that is read", ImageError):
                    picture_format(other)
    for other in (
        b"",
        b"P0CMYK 1 1 255\n",
        b"P7\n",
        b"Pf\n",
        b"PyP\n",
        b"RIFFAVI WAVE",
        b"GIF89a",
        b"<svg/>",
    ):
        with pytest.raises(ImageError, match=re.escape(PICTURE_NAMES)):
            picture_format(other)


@pytest.mark.parametrize("start", [b"", b"\n", b" ", b"BM", b"\xff\xd8\xff", b"P6\n"])
@pytest.mark.parametrize("content", [POSTSCRIPT, DOS_POSTSCRIPT + POSTSCRIPT])
def test_postscript_never_reaches_ghostscript(monkeypatch, start, content):
    started = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *given, **_: started.append(given))
    monkeypatch.setattr(EpsImagePlugin, "has_ghostscript", lambda: True)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    with pytest.raises(ImageError):
        open_picture(start + content).load()
    assert not started


def test_open_picture_bounds_bytes_pixels_and_scans(monkeypatch):
    progressive = _saved("JPEG", progressive=True)
    scan = progressive[progressive.rindex(b"\xff\xda") : -2]
    whole = progressive[:-2]
    scans = progressive.count(b"\xff\xda")
    open_picture(whole + (pictures.MAX_IMAGE_SCANS - scans) * scan).close()
    with refused("a JPEG of 65 scans, more than 64", ImageError):
        open_picture(whole + (pictures.MAX_IMAGE_SCANS - scans + 1) * scan)
    square = _saved("PNG")
    monkeypatch.setattr(pictures, "MAX_IMAGE_PIXELS", 64)
    open_picture(square).close()
    monkeypatch.setattr(pictures, "MAX_IMAGE_PIXELS", 63)
    with refused(r"more than .* pixels; scale it down", ImageError):
        open_picture(square)
    monkeypatch.setattr(pictures, "MAX_IMAGE_BYTES", len(square))
    monkeypatch.setattr(pictures, "MAX_IMAGE_PIXELS", 64)
    open_picture(square).close()
    with refused(r"larger than [\d,]+ bytes; save it smaller", ImageError):
        open_picture(square + b"\0")


def test_messages_of_damaged_pictures_are_one_line_and_say_what_to_do():
    message = "damaged or truncated, or of a kind that is not read; convert it to JPEG or PNG"
    for data in (b"BM" + b"secret" * 9, b"\xff\xd8\xff" + b"secret" * 9, b"II*\0" + b"secret" * 9):
        with pytest.raises(ImageError) as caught:
            open_picture(data)
        assert "secret" not in str(caught.value)
        assert "\n" not in str(caught.value)
    for error in (OSError(), OSError("\nmore")):
        assert str(pictures.damaged_picture(error)) == message
    bomb = pictures.damaged_picture(Image.DecompressionBombError("2 x 2"))
    assert str(bomb) == f"more than {MAX_IMAGE_PIXELS:,} pixels; scale it down"


@pytest.mark.parametrize(
    "content",
    [
        b"P3 2 1 255 1 2 3 4 5 6",
        b"P3 # a\n# b\r\n2\t1 #c\n255\n1 2 3 # red\n4 5 6#",
        b"P3\n2 1\n255\n1 2#x\n3 4 5 6\n",
        b"P6 2#\n1\n#d\n255\n\1\2\3\4\5\6",
        b"P6\n2 1\n255\n\1\2\3\4\5\6",
    ],
)
def test_comments_of_ppm_are_left_out(content):
    assert list(open_picture(content).tobytes()) == [1, 2, 3, 4, 5, 6]


def test_bytes_of_binary_ppm_are_no_comments():
    assert open_picture(b"P5 3 1 255\n#\n#").tobytes() == b"#\n#"
    assert (
        open_picture(b"P4 8 1\n#").tobytes() == open_picture(b"P1 8 1\n0 0 1 0 0 0 1 1").tobytes()
    )


@pytest.mark.parametrize(
    "make",
    [
        lambda n: b"P3 90 90 255 " + b"#\n" * n,
        lambda n: b"P2 90 90 255 " + b"1#\n" * n,
        lambda n: b"P1 90 90 " + b"#\n1" * n,
        lambda n: b"P6 #" + b"x" * n + b"\n 3 3 255 aaa",
        lambda n: b"P6 " + b" " * n,
        lambda n: b"P6 " + b"#\n" * n,
        lambda n: b"P6 3 3" + b"\n" * n,
        lambda n: b"P6 " + b"1" * n,
    ],
)
def test_ppm_is_read_in_linear_time(make):
    def read(data):
        with suppress(Exception):  # Pillow's own of what is cut
            open_picture(data).load()

    check_linear(read, make, 100_000)


def test_a_long_header_of_ppm_is_refused():
    room = pictures.MAX_PPM_HEADER - len(b"P6 1 1 255\n")
    assert open_picture(b"P6 " + b" " * room + b"1 1 255\nabc").tobytes() == b"abc"
    for header in (
        b"P6 " + b" " * (room + 1) + b"1 1 255\n",
        b"P5 1 1",
        b"P5 1 1 x ",
        b"P5 1 12345678901 255 ",
    ):
        with refused("long header; convert it to JPEG or PNG", ImageError):
            open_picture(header + b"abc")


def test_pillow_is_given_the_one_decoder_that_the_first_bytes_name(monkeypatch):
    """Else it would ask all of them when the right one refuses a damaged file."""
    asked = []

    def refuse(_, formats=None):
        asked.append(formats)
        raise OSError("damaged")

    png = _saved("PNG")
    monkeypatch.setattr(Image, "open", refuse)
    for data in (png, b"BM" + bytes(50), b"\xff\xd8\xff" + bytes(50)):
        with refused(r"damaged or truncated \(damaged\)", ImageError):
            open_picture(data)
    assert asked == [["PNG"], ["BMP"], ["JPEG"]]


def _tiled(width, height, kind=4):
    """A TIFF of 10 x 10 px in one tile, which libtiff decodes as a whole."""
    values = {256: 10, 257: 10, 258: 8, 259: 5, 262: 1, 277: 1, 322: width, 323: height}
    data = 8 + 2 + 12 * (len(values) + 2) + 4
    values |= {324: data, 325: 64}
    rows = [
        struct.pack("<HHII", tag, kind if tag == 322 else 4, 1, value)
        for tag, value in values.items()
    ]
    head = b"II*\0" + struct.pack("<IH", 8, len(rows))
    return head + b"".join(rows) + bytes(4) + bytes(64)


def test_a_small_tiff_of_a_huge_tile_is_refused_before_it_is_decoded():
    """1 kB took 1.2 GB."""
    with refused("pixels; scale it down", ImageError):
        open_picture(_tiled(20_000, 20_000))
    with refused("damaged or truncated", ImageError):
        open_picture(_tiled(int.from_bytes(b"ab\0\0", "little"), 16, kind=2))
    assert open_picture(_tiled(16, 16)).size == (10, 10)
    assert open_picture(_tiled(9_456, 9_456)).size == (10, 10)
