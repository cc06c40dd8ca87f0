"""HEIC and AVIF, the photographs of telephones, by optional decoders that are loaded when one is
read."""

import re
from io import BytesIO
from typing import TYPE_CHECKING

from ..errors import MissingDependencyError
from ..utils.extras import install_command
from ..utils.pictures import open_picture

if TYPE_CHECKING:
    from PIL.Image import Image

_START = re.compile(rb".{4}ftyp", re.DOTALL)
_HEIC = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"}
_AVIF = {b"avif", b"avis"}
_MAX_BRANDS_BYTES = 400  # of the box that names a file's kinds


def heif_kind(data: bytes) -> str | None:
    """ "HEIC" or "AVIF" by the brands that a file's first box names; None of any other file."""
    if not _START.match(data):
        return None
    size = min(int.from_bytes(data[:4], "big"), _MAX_BRANDS_BYTES)
    places = [8, *range(16, size - 3, 4)]  # the main brand, its version, and the compatible ones
    brands = {data[place : place + 4] for place in places}
    if brands & _AVIF:
        return "AVIF"
    return "HEIC" if brands & _HEIC else None


def open_photograph(data: bytes) -> "Image":
    """:func:`.open_picture`, and HEIC and AVIF too, whose size the caller checks, within
    :func:`.decoding`; pixels are not decoded yet. Pictures of HEIC are turned as its properties
    say: their EXIF orientation is 1.

    Raises:
        MissingDependencyError: the decoder is not installed.
        ImageError: as by :func:`.open_picture`.
    """
    kind = heif_kind(data)
    if kind is None:
        return open_picture(data)
    return _heic(data) if kind == "HEIC" else _avif(data)


def _heic(data: bytes) -> "Image":
    try:
        from pi_heif import HeifImageFile
    except ImportError as error:
        raise MissingDependencyError(
            f"HEIC needs pi-heif: {install_command(['heic'])}, or save it as JPEG"
        ) from error
    image: Image = HeifImageFile(BytesIO(data))
    return image


def _avif(data: bytes) -> "Image":
    from PIL import Image, features

    if "avif" not in features.modules or not features.check("avif"):
        raise MissingDependencyError(
            "AVIF needs Pillow 11.3: pip install 'pillow>=11.3', or save it as JPEG"
        )
    return Image.open(BytesIO(data), formats=["AVIF"])
