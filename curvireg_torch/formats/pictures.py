"""Pictures of files: opened within bounds, with the metadata that say how they were taken."""

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import MAX_IMAGE_BYTES, CurviregError, ImageError, MissingFileError
from ..utils.aliases import Size
from ..utils.arrays import Array
from ..utils.pictures import check_pixels, decoding
from .boxes import PictureSize
from .heif import open_photograph

if TYPE_CHECKING:
    from PIL.Image import Image

_WIDTH = 256
_HEIGHT = 257
_SUBFILE = 254
_ORIENTATION = 0x0112
_EXIF_DIRECTORY = 0x8769
_FOCAL_35MM = 0xA405
_FOCAL = 0x920A  # in mm, of the lens itself
# EXIF pixels per unit of length of the sensor, and the unit: 2 = inch, 3 = cm, 4 = mm, 5 = um
_DIGITAL_ZOOM = 0xA404
_SENSOR_X = 0xA20E
_SENSOR_Y = 0xA20F
_SENSOR_UNIT = 0xA210
_SENSOR_UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
# EXIF sizes in px of the picture that the camera took
_TAKEN_WIDTH = 0xA002
_TAKEN_HEIGHT = 0xA003
_SENSOR_DIAGONALS = (2.0, 80.0)  # mm, of telephones and of medium format: others are mistakes
MAX_DIGITAL_ZOOM = 200.0  # of telephones; larger values of EXIF are mistakes
_PANORAMA = re.compile(
    rb"GPano:ProjectionType"
)  # in XMP, of a telephone or a camera of 360 degrees
MAX_METADATA_BYTES = 1 << 17  # at the start of a file, in which XMP is looked for
MAX_THUMBNAILS = 20  # pages of a TIFF before its full picture

DIAGONAL_35MM = math.hypot(36.0, 24.0)
"""mm of a picture on film of 35 mm."""


class Metadata(NamedTuple):
    """What is used of a file's metadata, see :class:`Photo`."""

    orientation: int
    focal_35mm: float | None
    taken_size: Size | None
    digital_zoom: float
    is_stitched: bool


def picture_size(path: Path) -> PictureSize:
    """The size of a photograph as :func:`read_photo` shows it, from its header; errors are the
    same."""
    with opened_picture(path) as (image, orientation, _):
        # of a TIFF, whose size Pillow turns or not, by its version
        tags = getattr(image, "tag_v2", {})
        stored = int(tags.get(_HEIGHT, image.height)), int(tags.get(_WIDTH, image.width))
    return PictureSize(stored[::-1] if orientation > 4 else stored, orientation)


@contextmanager
def opened_picture(path: Path) -> Iterator[tuple["Image", int, bytes]]:
    """Context with the picture of a file, its EXIF orientation, and the bytes of the file.

    Raises:
        MissingFileError: the file does not exist.
        CurviregError: it cannot be decoded, also within the context, or a decoder is missing.
    """
    if not path.is_file():
        raise MissingFileError("no such file; check the path of the photograph", subject=path)
    if path.stat().st_size > MAX_IMAGE_BYTES:
        raise ImageError(f"larger than {MAX_IMAGE_BYTES:,} bytes; save it smaller", subject=path)
    try:
        with decoding():
            data = path.read_bytes()
            with open_photograph(data) as image:
                _seek_full_image(image)
                check_pixels(image)
                yield image, picture_metadata(image).orientation, data
    except CurviregError as error:
        raise error.with_subject(path) from error.__cause__


def as_in_file(pixels: Array, image: "Image", orientation: int) -> Array:
    """Decoded pixels (H, W) or (H, W, C) as they are stored: Pillow applies the orientation of a
    TIFF, which is taken back."""
    return (
        oriented(pixels, {6: 8, 8: 6}.get(orientation, orientation))
        if image.format == "TIFF"
        else pixels
    )


def oriented(x: Array, orientation: int) -> Array:
    """Stored pixels (H, W) or (H, W, C) as viewers show them, for an EXIF orientation."""
    x = x[:: -1 if orientation in (3, 4, 6, 7) else 1, :: -1 if orientation in (2, 3, 7, 8) else 1]
    return x.swapaxes(0, 1) if orientation > 4 else x


def _seek_full_image(image: "Image") -> None:
    """Go to the first picture of a TIFF that is not marked as a reduced copy of another."""
    if image.format == "TIFF":
        with suppress(EOFError):
            for page in range(MAX_THUMBNAILS):
                image.seek(page)
                if not int(image.tag_v2.get(_SUBFILE, 0)) & 1:  # type: ignore[attr-defined]
                    return
        raise ImageError("holds thumbnails only; export the picture as JPEG or PNG")


def picture_metadata(image: "Image", data: bytes = b"") -> Metadata:
    """The metadata of a picture; what is damaged gives orientation 1, and None."""
    orientation = 1
    focal = 0.0
    zoom = 1.0
    width = height = 0
    with suppress(Exception):
        exif = image.getexif()
        orientation = exif.get(_ORIENTATION, 1)
        directory = exif.get_ifd(_EXIF_DIRECTORY)
        focal = float(directory.get(_FOCAL_35MM, 0))
        width = int(directory.get(_TAKEN_WIDTH, 0))
        height = int(directory.get(_TAKEN_HEIGHT, 0))
        stated = float(directory.get(_DIGITAL_ZOOM, 0))
        zoom = stated if 1.0 < stated <= MAX_DIGITAL_ZOOM else 1.0
        if focal == 0.0:
            size = (width, height) if width > 0 and height > 0 else image.size
            focal = zoom * _focal_by_sensor(directory, size)
            zoom = 1.0
    valid = isinstance(orientation, int) and orientation in range(1, 9)
    found = image.info.get("xmp", b"")  # that Pillow has found
    xmp = found if isinstance(found, bytes) else str(found).encode()
    return Metadata(
        orientation if valid else 1,
        focal if 0 < focal < math.inf else None,
        (height, width) if width > 0 and height > 0 else None,
        zoom if focal > 0 else 1.0,
        any(_PANORAMA.search(part) for part in (data[:MAX_METADATA_BYTES], xmp)),
    )


def _focal_by_sensor(directory: Mapping[int, Any], size: tuple[int, int]) -> float:
    """The focal length in mm of a 36 x 24 mm camera of the same view, from that of the lens and the
    distance of the sensor's pixels; 0 where they are not stated, or no sensor has this size."""
    unit = _SENSOR_UNITS_MM[int(directory.get(_SENSOR_UNIT, 2))]
    along_x = float(directory[_SENSOR_X]) / unit
    along_y = float(directory.get(_SENSOR_Y, directory[_SENSOR_X])) / unit
    width, height = size
    diagonal = math.hypot(width / along_x, height / along_y)
    least, most = _SENSOR_DIAGONALS
    has_square_pixels = abs(along_x / along_y - 1.0) < 0.02
    if not (has_square_pixels and least <= diagonal <= most):
        return 0.0
    return float(directory[_FOCAL]) * DIAGONAL_35MM / diagonal
