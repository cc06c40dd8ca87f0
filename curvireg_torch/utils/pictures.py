"""Pictures of unknown origin: which are decoded, decided by their first bytes before any decoder
sees them.

Photographs, masks and textures are opened here and nowhere else. Pillow would choose a decoder by
itself, and hand PostScript to Ghostscript.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import TYPE_CHECKING

from ..errors import MAX_IMAGE_BYTES, MAX_IMAGE_PIXELS, MAX_IMAGE_SCANS, CurviregError, ImageError
from .files import foreign_content

if TYPE_CHECKING:
    from PIL.Image import Image

PICTURE_STARTS = {
    "JPEG": re.compile(rb"\xff\xd8\xff"),
    "PNG": re.compile(rb"\x89PNG\r\n\x1a\n"),
    "TIFF": re.compile(rb"II\*\0|MM\0\*|II\+\0|MM\0\+"),
    "WEBP": re.compile(rb"RIFF.{4}WEBP", re.DOTALL),
    "BMP": re.compile(rb"BM"),
    "PPM": re.compile(rb"P[1-6]\s"),
}
"""First bytes of the formats that are decoded, by Pillow's names; SECURITY.md lists the same
formats."""

PICTURE_NAMES = "JPEG, PNG, TIFF, WebP, BMP, PBM, PGM, PPM"
MAX_PPM_HEADER = 4096  # bytes of the sizes at the start of a PBM, PGM or PPM file, with comments
_COMMENT = re.compile(rb"#[^\r\n]*")
_NUMBER = rb"(?:\s|#[^\r\n]*[\r\n])+\d{1,10}"
_PPM_HEADER = re.compile(rb"P(?:[14](?:%b){2}|[2356](?:%b){3})\s" % (_NUMBER, _NUMBER))
_TOO_MANY_PIXELS = f"more than {MAX_IMAGE_PIXELS:,} pixels; scale it down"
# Tags of TIFF
_TILE_WIDTH = 322
_TILE_HEIGHT = 323
_SCAN_OF_JPEG = re.compile(rb"\xff\xda\0[\x08\x0a\x0c\x0e][\1-\4]")


def picture_format(data: bytes) -> str:
    """Pillow's name of a picture's format, by its first bytes; ImageError for any other content."""
    for name, start in PICTURE_STARTS.items():
        if start.match(data):
            return name
    foreign = foreign_content(data[:200])
    if foreign is not None:
        raise ImageError(foreign)
    raise ImageError(f"not an image that is read ({PICTURE_NAMES}); convert it to JPEG or PNG")


def open_picture(data: bytes) -> "Image":
    """A picture whose pixels are not decoded yet, to be closed by the caller.

    Raises:
        ImageError: another format, a damaged header, or a picture beyond
            :mod:`curvireg_torch.errors`.

    Example:
        >>> from PIL import Image
        >>> file = BytesIO()
        >>> Image.new("L", (6, 4)).save(file, "PNG")
        >>> open_picture(file.getvalue()).size
        (6, 4)
    """
    from PIL import Image

    if len(data) > MAX_IMAGE_BYTES:
        raise ImageError(f"larger than {MAX_IMAGE_BYTES:,} bytes; save it smaller")
    name = picture_format(data)
    if name == "JPEG":
        _check_scans(data)
    if name == "PPM":
        data = _without_comments(data)
    with decoding():
        image = Image.open(BytesIO(data), formats=[name])
    check_pixels(image)
    return image


def check_pixels(image: "Image") -> None:
    """Refuse a picture of too many pixels, or of TIFF's tiles, which are decoded as a whole however
    small the picture is; after each change of the page of a file with several."""
    tags = getattr(image, "tag_v2", {})
    with decoding():  # sides may be no numbers
        tile = int(tags.get(_TILE_WIDTH, 0)) * int(tags.get(_TILE_HEIGHT, 0))
    if max(image.width * image.height, tile) > MAX_IMAGE_PIXELS:
        raise ImageError(_TOO_MANY_PIXELS)


@contextmanager
def decoding() -> Iterator[None]:
    """Within, whatever a decoder raises becomes an :class:`ImageError`; errors of ours stay."""
    try:
        yield
    except CurviregError:
        raise
    except Exception as error:  # decoders raise errors of any kind for damaged files
        raise damaged_picture(error) from error


def damaged_picture(error: Exception) -> ImageError:
    """The error of ours for what Pillow raises about a file."""
    from PIL import Image, UnidentifiedImageError

    if isinstance(error, Image.DecompressionBombError | Image.DecompressionBombWarning):
        return ImageError(_TOO_MANY_PIXELS)
    reason = str(error).partition("\n")[0]
    if isinstance(error, UnidentifiedImageError) or not reason:
        return ImageError(
            "damaged or truncated, or of a kind that is not read; convert it to JPEG or PNG"
        )
    return ImageError(f"damaged or truncated ({reason}); fetch or save the file again")


def _without_comments(data: bytes) -> bytes:
    """A PBM, PGM or PPM file without what Pillow reads byte by byte, or with a copy of the rest for
    each comment."""
    header = _PPM_HEADER.match(data[:MAX_PPM_HEADER])
    if header is None:
        raise ImageError("damaged or truncated, or with a long header; convert it to JPEG or PNG")
    start = header.end()
    head = _COMMENT.sub(b"", data[:start])
    is_text = data[:2] in (b"P1", b"P2", b"P3")
    return head + (_COMMENT.sub(b"", data[start:]) if is_text else data[start:])


def _check_scans(data: bytes) -> None:
    """Refuse a progressive JPEG of so many scans that Pillow would decode it for hours."""
    scans = len(_SCAN_OF_JPEG.findall(data))
    if scans > MAX_IMAGE_SCANS:
        raise ImageError(f"a JPEG of {scans} scans, more than {MAX_IMAGE_SCANS}; save it again")
