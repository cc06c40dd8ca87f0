"""What a photograph's file says of itself, read before anything is decoded."""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from .exif import Directory, Exif, read_exif

__all__ = ["ImageHeader", "read_header"]


@dataclass(frozen=True)
class ImageHeader:
    """Size and make of a picture.

    Attributes:
        width, height: px, as stored.
        colour: "RGB", "grey", "palette" or "CMYK".
        bits: of a channel.
        alpha: whether it has an alpha channel.
        exif: orientation and focal length.
        data: the bytes to decode: without what follows the picture's end, and with orientation 1 where the decoder
            would otherwise turn the picture.
        surplus: bytes behind the picture's end.
        scans: passes over the picture.
        pages: whether more than one picture is inside.
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
    pages: bool = False


_TRUNCATED = "the image is truncated; fetch the file again"
_STARTS_SEGMENT = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def read_header(data: bytes) -> ImageHeader:
    """The header of a JPEG, PNG, TIFF, WebP, BMP, PGM or PPM file.

    Raises:
        ValueError: another format, or damaged; the message is for the user.
    """
    try:
        for start, reader in _READERS.items():
            if data.startswith(start):
                return reader(data)
    except (struct.error, IndexError):
        raise ValueError(_TRUNCATED) from None
    for start, offset, name in _OTHERS:
        if data[offset:].startswith(start):
            raise ValueError(f"{name} is not read; convert it to JPEG or PNG")
    raise ValueError("not an image; expected JPEG, PNG, TIFF, WebP, BMP, PGM or PPM")


def _jpeg(data: bytes) -> ImageHeader:
    position, scans, frame, exif = 2, 0, None, Exif()
    while True:
        found = _STARTS_SEGMENT.search(data, position)
        if found is None:
            raise ValueError(_TRUNCATED)
        marker, position = data[found.end() - 1], found.end()
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
    return ImageHeader(
        width, height, data[:position], colour, bits, exif=exif, surplus=len(data) - position, scans=scans
    )


def _png(data: bytes) -> ImageHeader:
    position, exif, alpha, pages = 8, Exif(), False, False
    while True:
        length, kind = struct.unpack_from(">I4s", data, position)
        begin, position = position + 8, position + 12 + length
        if position > len(data):
            raise ValueError(_TRUNCATED)
        if kind == b"eXIf":
            exif = read_exif(data[begin : begin + length])
        alpha |= kind == b"tRNS"
        pages |= kind == b"acTL"
        if kind == b"IEND":
            break
    size, kind, width, height, bits, colour = struct.unpack_from(">I4sIIBB", data, 8)
    if kind != b"IHDR" or size != 13:
        raise ValueError("not an image: a PNG without a header")
    name = {0: "grey", 3: "palette", 4: "grey"}.get(colour, "RGB")
    alpha |= colour in (4, 6)
    return ImageHeader(
        width, height, data[:position], name, bits, alpha, exif, surplus=len(data) - position, pages=pages
    )


def _tiff(data: bytes) -> ImageHeader:
    try:
        directory = Directory(data)
    except ValueError:
        raise ValueError(_TRUNCATED) from None
    width, height, bits, kind, samples = (
        directory.get(tag, default) for tag, default in ((256, 0), (257, 0), (258, 1), (262, 1), (277, 1))
    )
    if kind in (8, 9, 10):  # decoded with other colours
        raise ValueError("a TIFF in CIELAB is not read; convert it to RGB")
    colour = {0: "grey", 1: "grey", 3: "palette", 5: "CMYK"}.get(kind, "RGB")
    exif = read_exif(data)
    if exif.orientation != 1:  # OpenCV turns a TIFF whatever it is told
        place = directory.places[274]
        data = data[:place] + struct.pack(directory.order + "HH", 1, 0) + data[place + 4 :]
    alpha = samples > {"grey": 1, "palette": 1, "CMYK": 4}.get(colour, 3)
    return ImageHeader(width, height, data, colour, bits, alpha, exif, pages=directory.next != 0)


def _webp(data: bytes) -> ImageHeader:
    (size,) = struct.unpack_from("<I", data, 4)
    if data[8:12] != b"WEBP":
        raise ValueError("not an image: a RIFF file that is no WebP")
    end, position, exif, alpha, pages = 8 + size, 12, Exif(), False, False
    if end > len(data):
        raise ValueError(_TRUNCATED)
    sizes = []
    while position + 8 <= end:
        kind, length = struct.unpack_from("<4sI", data, position)
        begin, position = position + 8, position + 8 + length + length % 2
        if kind == b"VP8X":
            flags, wide, high = data[begin], data[begin + 4 : begin + 7], data[begin + 7 : begin + 10]
            sizes.append((int.from_bytes(wide, "little") + 1, int.from_bytes(high, "little") + 1))
            alpha, pages = bool(flags & 16), bool(flags & 2)
        elif kind == b"VP8 ":
            wide, high = struct.unpack_from("<HH", data, begin + 6)
            sizes.append((wide & 0x3FFF, high & 0x3FFF))
        elif kind == b"VP8L":
            (word,) = struct.unpack_from("<I", data, begin + 1)
            sizes.append(((word & 0x3FFF) + 1, (word >> 14 & 0x3FFF) + 1))
            alpha |= bool(word >> 28 & 1)
        elif kind == b"EXIF":
            exif = read_exif(data[begin : begin + length].removeprefix(b"Exif\0\0"))
    if not sizes:
        raise ValueError("not an image: a WebP without a picture in it")
    width, height = max(sizes)
    return ImageHeader(width, height, data[:end], "RGB", 8, alpha, exif, surplus=len(data) - end, pages=pages)


def _bmp(data: bytes) -> ImageHeader:
    (size,) = struct.unpack_from("<I", data, 14)
    if size == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
    else:
        width, height, _, bits = struct.unpack_from("<iiHH", data, 18)
    return ImageHeader(abs(width), abs(height), data, "palette" if bits <= 8 else "RGB", 8, bits == 32)


def _pnm(data: bytes) -> ImageHeader:
    words: list[bytes] = []
    for line in data[2:1024].splitlines():
        words += line.split(b"#")[0].split()
    if len(words) < 3 or not all(word.isdigit() for word in words[:3]):
        raise ValueError(_TRUNCATED)
    width, height, top = (int(word) for word in words[:3])
    return ImageHeader(width, height, data, "grey" if data[1:2] in b"25" else "RGB", 8 if top < 256 else 16)


_READERS: dict[bytes, Callable[[bytes], ImageHeader]] = {
    b"\xff\xd8": _jpeg,
    b"\x89PNG\r\n\x1a\n": _png,
    b"II*\0": _tiff,
    b"MM\0*": _tiff,
    b"RIFF": _webp,
    b"BM": _bmp,
    b"P2": _pnm,
    b"P3": _pnm,
    b"P5": _pnm,
    b"P6": _pnm,
}
_OTHERS = [
    (b"ftyphe", 4, "HEIC"),
    (b"ftypmif1", 4, "HEIC"),
    (b"ftypmsf1", 4, "HEIC"),
    (b"ftypavi", 4, "AVIF"),
    (b"ftyp", 4, "a video"),
    (b"\0\0\0\x0cjP", 0, "JPEG 2000"),
    (b"\xff\x0a", 0, "JPEG XL"),
    (b"\0\0\0\x0cJXL", 0, "JPEG XL"),
    (b"GIF8", 0, "GIF"),
    (b"II+\0", 0, "BigTIFF"),
    (b"MM\0+", 0, "BigTIFF"),
    (b"\x76\x2f\x31\x01", 0, "OpenEXR"),
    (b"#?R", 0, "Radiance HDR"),
    (b"8BPS", 0, "Photoshop"),
    (b"%PDF", 0, "PDF"),
    (b"<svg", 0, "SVG"),
]
