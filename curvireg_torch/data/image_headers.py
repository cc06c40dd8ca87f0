"""Headers of image files, read before anything is decoded.

Pillow's headers do not suffice: they neither count the scans of a progressive JPEG, which may take hours to decode, nor
find where the picture ends before other data, nor say where a TIFF stores its orientation.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from .exif import Directory, Exif, read_exif


@dataclass(frozen=True)
class ImageHeader:
    """Size (px, as stored) and format of a picture.

    Attributes:
        data: the bytes to decode; a TIFF's orientation is set to 1, because OpenCV always applies it.
        colour: "RGB", "grey", "palette" or "CMYK".
        surplus: number of bytes after the picture, which ``data`` omits.
        scans: passes over the picture.
    """

    width: int
    height: int
    data: bytes
    colour: str = "RGB"
    bits: int = 8
    alpha: bool = False
    exif: Exif = field(default_factory=Exif)
    surplus: int = 0
    scans: int = 1
    has_more_pages: bool = False


_TRUNCATED = "the image is truncated; fetch the file again"
_STARTS_SEGMENT = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def read_header(data: bytes) -> ImageHeader:
    """The header of a file; ValueError, with a message for the user, for another format or a damaged file."""
    try:
        for start, reader in _READERS.items():
            if data.startswith(start):
                return reader(data)
    except (struct.error, IndexError):
        raise ValueError(_TRUNCATED) from None
    for start, name in _OTHERS.items():
        if data.startswith(start) or (start.startswith(b"ftyp") and data[4:].startswith(start)):
            raise ValueError(f"{name} is not read; convert it to JPEG or PNG")
    raise ValueError("not an image; expected JPEG, PNG, TIFF, WebP, BMP, PGM or PPM")


def _jpeg(data: bytes) -> ImageHeader:
    position, scans, frame, exif = 2, 0, None, Exif()
    while True:
        segment = _STARTS_SEGMENT.search(data, position)
        if segment is None:
            raise ValueError(_TRUNCATED)
        marker, position = data[segment.end() - 1], segment.end()
        if marker == 0xD9:
            break
        if marker in (0x01, 0xD8):  # no content
            continue
        (length,) = struct.unpack_from(">H", data, position)
        content = data[position + 2 : position + length]
        position += length
        if length < 2 or position > len(data):
            raise ValueError(_TRUNCATED)
        if marker in _FRAMES and frame is None:
            frame = struct.unpack_from(">BHHB", content)
        elif marker == 0xE1 and content.startswith(b"Exif\0\0") and exif == Exif():
            exif = read_exif(content[6:])
        scans += marker == 0xDA
    if frame is None or scans == 0:
        raise ValueError("not an image: a JPEG without a picture in it")
    bits, height, width, channels = frame
    colour = {1: "grey", 4: "CMYK"}.get(channels, "RGB")
    surplus = len(data) - position
    return ImageHeader(width, height, data[:position], colour, bits, exif=exif, surplus=surplus, scans=scans)


def _png(data: bytes) -> ImageHeader:
    position, exif, alpha, animated, kind = 8, Exif(), False, False, b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, position)
        start, position = position + 8, position + 12 + length
        if position > len(data):
            raise ValueError(_TRUNCATED)
        if kind == b"eXIf":
            exif = read_exif(data[start : start + length])
        alpha |= kind == b"tRNS"
        animated |= kind == b"acTL"
    size, kind, width, height, bits, colour_type = struct.unpack_from(">I4sIIBB", data, 8)
    if kind != b"IHDR" or size != 13:
        raise ValueError("not an image: a PNG without a header")
    colour = {0: "grey", 3: "palette", 4: "grey"}.get(colour_type, "RGB")
    alpha |= colour_type in (4, 6)
    surplus = len(data) - position
    return ImageHeader(width, height, data[:position], colour, bits, alpha, exif, surplus, has_more_pages=animated)


def _tiff(data: bytes) -> ImageHeader:
    try:
        directory = Directory(data)
    except ValueError:
        raise ValueError(_TRUNCATED) from None
    defaults = {256: 0, 257: 0, 258: 1, 262: 1, 277: 1}
    width, height, bits, interpretation, samples = (directory.get(tag, default) for tag, default in defaults.items())
    if interpretation in (8, 9, 10):  # OpenCV decodes these with wrong colours
        raise ValueError("a TIFF in CIELAB is not read; convert it to RGB")
    colour = {0: "grey", 1: "grey", 3: "palette", 5: "CMYK"}.get(interpretation, "RGB")
    exif = read_exif(data)
    if exif.orientation != 1:
        offset = directory.offsets[274]
        data = data[:offset] + struct.pack(directory.order + "HH", 1, 0) + data[offset + 4 :]
    alpha = samples > {"grey": 1, "palette": 1, "CMYK": 4}.get(colour, 3)
    return ImageHeader(width, height, data, colour, bits, alpha, exif, has_more_pages=directory.next != 0)


def _webp(data: bytes) -> ImageHeader:
    (size,) = struct.unpack_from("<I", data, 4)
    if data[8:12] != b"WEBP":
        raise ValueError("not an image: a RIFF file other than WebP")
    end, position, exif, alpha, animated = 8 + size, 12, Exif(), False, False
    if end > len(data):
        raise ValueError(_TRUNCATED)
    sizes = []
    while position + 8 <= end:
        kind, length = struct.unpack_from("<4sI", data, position)
        start, position = position + 8, position + 8 + length + length % 2
        if kind == b"VP8X":
            flags, wide, high = data[start], data[start + 4 : start + 7], data[start + 7 : start + 10]
            sizes.append((int.from_bytes(wide, "little") + 1, int.from_bytes(high, "little") + 1))
            alpha, animated = bool(flags & 16), bool(flags & 2)
        elif kind == b"VP8 ":
            wide, high = struct.unpack_from("<HH", data, start + 6)
            sizes.append((wide & 0x3FFF, high & 0x3FFF))
        elif kind == b"VP8L":
            (word,) = struct.unpack_from("<I", data, start + 1)
            sizes.append(((word & 0x3FFF) + 1, (word >> 14 & 0x3FFF) + 1))
            alpha |= bool(word >> 28 & 1)
        elif kind == b"EXIF":
            exif = read_exif(data[start : start + length].removeprefix(b"Exif\0\0"))
    if not sizes:
        raise ValueError("not an image: a WebP without a picture in it")
    width, height = max(sizes)
    surplus = len(data) - end
    return ImageHeader(width, height, data[:end], alpha=alpha, exif=exif, surplus=surplus, has_more_pages=animated)


def _bmp(data: bytes) -> ImageHeader:
    (size,) = struct.unpack_from("<I", data, 14)
    width, height, _, bits = struct.unpack_from("<HHHH" if size == 12 else "<iiHH", data, 18)
    return ImageHeader(abs(width), abs(height), data, "palette" if bits <= 8 else "RGB", 8, bits == 32)


def _pnm(data: bytes) -> ImageHeader:
    words: list[bytes] = []
    for line in data[2:1024].splitlines():
        words += line.split(b"#")[0].split()
    if len(words) < 3 or not all(word.isdigit() for word in words[:3]):
        raise ValueError(_TRUNCATED)
    width, height, maximum = (int(word) for word in words[:3])
    return ImageHeader(width, height, data, "grey" if data[1:2] in b"25" else "RGB", 8 if maximum < 256 else 16)


_READERS: dict[bytes, Callable[[bytes], ImageHeader]] = {
    b"\xff\xd8": _jpeg,
    b"\x89PNG\r\n\x1a\n": _png,
    **dict.fromkeys((b"II*\0", b"MM\0*"), _tiff),
    b"RIFF": _webp,
    b"BM": _bmp,
    **dict.fromkeys((b"P2", b"P3", b"P5", b"P6"), _pnm),
}
_OTHERS = {
    **dict.fromkeys((b"ftyphe", b"ftypmif1", b"ftypmsf1"), "HEIC"),
    b"ftypavi": "AVIF",
    b"ftyp": "a video",
    b"\0\0\0\x0cjP": "JPEG 2000",
    **dict.fromkeys((b"\xff\x0a", b"\0\0\0\x0cJXL"), "JPEG XL"),
    b"GIF8": "GIF",
    **dict.fromkeys((b"II+\0", b"MM\0+"), "BigTIFF"),
    b"\x76\x2f\x31\x01": "OpenEXR",
    b"#?R": "Radiance HDR",
    b"8BPS": "Photoshop",
    b"%PDF": "PDF",
    b"<svg": "SVG",
}
"""Starts of formats that are not read; those with ``ftyp`` follow the four bytes of a length."""
