"""Photographs and frames of videos from disk."""

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import MAX_IMAGE_BYTES, MAX_IMAGE_PIXELS, CurviregError, ImageError, MissingFileError
from ..formats.boxes import PictureSize
from ..geometry.calibration import Camera
from ..geometry.cameras import camera_matrix
from ..utils.checks import check_integer
from ..utils.pictures import check_pixels, damaged_picture
from .heif import open_photograph

if TYPE_CHECKING:
    from PIL.Image import Image

T = TypeVar("T")

_WIDTH = 256
_HEIGHT = 257
_PHOTOMETRIC = 262
_BITS = 258
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
MAX_THUMBNAILS = 20  # pages of a TIFF before its full picture

# EXIF sizes in px of the picture that the camera took
_TAKEN_WIDTH = 0xA002
_TAKEN_HEIGHT = 0xA003
USED_BITS = (8, 10, 12, 14)  # of cameras that write 16

_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_SENSOR_DIAGONALS = (2.0, 80.0)  # mm, of telephones and of medium format: others are mistakes

EXIF_DEVIATION = 0.05
"""Standard deviation of an EXIF focal length: it is rounded to whole millimetres, lens corrections
and stabilisers cut the border off, and some cameras mean the width by it, not the diagonal. An
estimate, not measured."""


ANIMATED = "one of several pictures"
"""Note about the first picture of an animation, or of a file of several."""

MAX_DIGITAL_ZOOM = 200.0  # of telephones; larger values of EXIF are mistakes
# Longer side over the shorter one beyond which a picture is a panorama, or a strip of another one
PANORAMA_PROPORTIONS = 2.5
_PANORAMA = re.compile(
    rb"GPano:ProjectionType"
)  # in XMP, of a telephone or a camera of 360 degrees
MAX_METADATA_BYTES = 1 << 17  # at the start of a file, in which XMP is looked for


@dataclass(frozen=True)
class Photo:
    """A photograph as viewers show it, and the metadata of its file.

    Attributes:
        image: (3, H, W) uint8 RGB.
        orientation: the EXIF orientation that was applied, 1 to 8; 1 = none.
        focal_35mm: EXIF focal length in mm of a 36 x 24 mm camera of the same view, as the file
            states it, or by the focal length of the lens and the size of the sensor; or None.
        notes: changes to the pixels, in words.
        taken_size: EXIF (H, W) in px of the picture that the camera took, before orientation; None
            if it is not known.
        digital_zoom: EXIF factor by which the picture was enlarged, where ``focal_35mm`` may be
            without it; 1 if there is none, or the focal length has it.
        is_stitched: whether the file says that it is a panorama.

    Example:
        >>> photo = Photo(torch.zeros(3, 48, 64, dtype=torch.uint8), 1, 28.0, ())
        >>> round(float(photo.camera().matrix[0, 0]))
        52
    """

    image: Tensor
    orientation: int
    focal_35mm: float | None
    notes: tuple[str, ...]
    taken_size: tuple[int, int] | None = None
    digital_zoom: float = 1.0
    is_stitched: bool = False

    @property
    def is_panorama(self) -> bool:
        """Whether no pinhole camera with its axis in the middle shows the picture: the file says
        so, or it has a camera's focal length and no camera's proportions."""
        H, W = self.image.shape[-2:]
        is_strip = max(H, W) > PANORAMA_PROPORTIONS * min(H, W)
        is_of_camera = self.focal_35mm is not None and not self.is_cropped
        return self.is_stitched or (is_strip and is_of_camera)

    @property
    def is_cropped(self) -> bool:
        """Whether the proportions of the pixels differ from those of the picture that the camera
        took."""
        H, W = self.image.shape[-2:]
        longer = max(H, W)
        shorter = min(H, W)
        if self.taken_size is None:
            return False
        taken = max(self.taken_size) / min(self.taken_size)
        return abs(shorter * taken - longer) > 1.0 + taken

    def guessed_camera_matrix(self) -> Tensor | None:
        """Return the (3, 3) float64 camera matrix from the EXIF focal length, or None without one.

        The focal length is relative to the diagonal of the picture that the camera took. A picture
        of its proportions is taken for a resized one, with the principal point in its centre. One
        of other proportions is taken for a part of it at full size, which is as large; None if it
        is larger, and of a panorama. With a digital zoom that the focal length may lack it is the
        mean, by ratio, of both.
        """
        if self.focal_35mm is None or self.is_panorama:
            return None
        H, W = self.image.shape[-2:]
        taken = (H, W)
        if self.is_cropped and self.taken_size is not None:
            taken = self.taken_size
            if max(H, W) > max(taken) or min(H, W) > min(taken):
                return None
        focal = self.focal_35mm * math.sqrt(self.digital_zoom)
        focal *= math.hypot(*taken) / _DIAGONAL_35MM
        return camera_matrix(focal, focal, (W - 1) / 2, (H - 1) / 2)

    def camera(self) -> Camera | None:
        """Return the camera of :meth:`guessed_camera_matrix`, or None."""
        K = self.guessed_camera_matrix()
        deviation = math.hypot(EXIF_DEVIATION, math.log(self.digital_zoom) / 2)
        return None if K is None else Camera(K, focal_deviation=deviation, source="exif")

    def facts(self) -> dict[str, Any]:
        """Return all but the pixels, as plain JSON."""
        H, W = self.image.shape[-2:]
        facts = {
            "width": W,
            "height": H,
            "orientation": self.orientation,
            "focal_35mm": self.focal_35mm,
        }
        return {**facts, "notes": list(self.notes)}


def read_photo(path: str | os.PathLike[str], *, as_stored: bool = False) -> Photo:
    """Read a photograph as viewers show it: the EXIF orientation is applied, and boxes refer to the
    result.

    Args:
        path: JPEG, PNG, TIFF, WebP, BMP, PBM, PGM or PPM with up to 16 bits per channel, which are
            rounded to 8; HEIC with the extra ``[heic]``, AVIF with a Pillow that has it. Of 16 bits
            of which a camera has used 8 to 14, these are stretched, with a note.
        as_stored: leave the orientation as it is in the file, to which boxes of datasets refer.

    Raises:
        MissingFileError: the file does not exist.
        ImageError: another format or bit depth, a damaged file, or one beyond
            :mod:`curvireg_torch.errors`.

    Example:
        >>> import tempfile
        >>> from PIL import Image
        >>> file = Path(tempfile.mkdtemp(), "grey.png")
        >>> Image.new("L", (6, 4), 51).save(file)
        >>> photo = read_photo(file)
        >>> photo.image.shape, int(photo.image[0, 0, 0]), photo.notes
        (torch.Size([3, 4, 6]), 51, ('grey: three equal channels',))
    """
    return _photo(*_decode(Path(path)), as_stored=as_stored)


def photo_of_picture(image: "Image") -> Photo:
    """A picture that Pillow has opened, as :func:`read_photo` reads its file; of one made in
    memory, its pixels.

    Raises:
        ImageError: a mode that is not read, a damaged file, or one beyond
            :mod:`curvireg_torch.errors`.
    """
    try:
        check_pixels(image)
        return _photo(*_decoded(image, b""))
    except ImageError:
        raise
    except Exception as error:  # Pillow raises errors of any kind for damaged files
        raise damaged_picture(error) from error


def _photo(
    rgb: NDArray[np.uint8], exif: "_Exif", notes: tuple[str, ...], *, as_stored: bool = False
) -> Photo:
    orientation = 1 if as_stored else exif.orientation
    if orientation != 1:
        notes = (f"EXIF orientation {orientation} applied", *notes)
    if exif.digital_zoom > 1.0:
        notes = (*notes, f"digital zoom {exif.digital_zoom:.3g}: perhaps not in the focal length")
    pixels = torch.from_numpy(np.array(oriented(rgb, orientation).transpose(2, 0, 1), order="C"))
    return Photo(
        pixels,
        orientation,
        exif.focal_35mm,
        notes,
        taken_size=exif.taken_size,
        digital_zoom=exif.digital_zoom,
        is_stitched=exif.is_stitched,
    )


def read_image(path: str | os.PathLike[str]) -> Tensor:
    """Read a photograph as it is stored, to which the boxes of datasets refer, as (3, H, W) float32
    RGB in [0, 1].

    Grey images get three equal channels, an alpha channel is dropped. Errors as in
    :func:`read_photo`.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from PIL import Image
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "photo.png"
        ...     Image.new("RGB", (64, 48)).save(path)
        ...     read_image(path).shape
        torch.Size([3, 48, 64])
    """
    return read_photo(path, as_stored=True).image.float().div_(255.0)


def picture_size(path: Path) -> PictureSize:
    """The size of a photograph as :func:`read_photo` shows it, from its header; errors are the
    same."""

    def stored_size(image: "Image", *_: object) -> tuple[int, int]:
        # of a TIFF, whose size Pillow turns or not, by its version
        tags = getattr(image, "tag_v2", {})
        return int(tags.get(_WIDTH, image.width)), int(tags.get(_HEIGHT, image.height))

    (width, height), orientation = decoded(path, stored_size)
    is_turned = orientation > 4
    return PictureSize((width, height) if is_turned else (height, width), orientation)


class _Exif(NamedTuple):
    """What is used of a file's metadata, see :class:`Photo`."""

    orientation: int
    focal_35mm: float | None
    taken_size: tuple[int, int] | None
    digital_zoom: float
    is_stitched: bool


def _decode(path: Path) -> tuple[NDArray[np.uint8], _Exif, tuple[str, ...]]:
    """(H, W, 3) RGB pixels as stored, metadata, and notes."""
    return decoded(path, lambda image, _, data: _decoded(image, data))[0]


def _decoded(image: "Image", data: bytes) -> tuple[NDArray[np.uint8], _Exif, tuple[str, ...]]:
    notes = _notes(image)
    exif = _exif(image, data)
    rgb, stretched = _rgb_pixels(image, data)
    return as_in_file(rgb, image, exif.orientation), exif, (*notes, *stretched)


def decoded(path: Path, read: Callable[["Image", int, bytes], T]) -> tuple[T, int]:
    """What ``read`` makes of the open picture of a file, its EXIF orientation and its bytes; and
    this orientation.

    Raises:
        MissingFileError: the file does not exist.
        CurviregError: it cannot be decoded, or a decoder is missing.
    """
    if not path.is_file():
        raise MissingFileError("no such file; check the path of the photograph", subject=path)
    if path.stat().st_size > MAX_IMAGE_BYTES:
        raise ImageError(f"larger than {MAX_IMAGE_BYTES:,} bytes; save it smaller", subject=path)
    try:
        data = path.read_bytes()
        with open_photograph(data) as image:
            _seek_full_image(image)
            check_pixels(image)
            orientation = _exif(image).orientation
            return read(image, orientation, data), orientation
    except CurviregError as error:
        raise error.with_subject(path) from error.__cause__
    except Exception as error:  # Pillow raises errors of any kind for damaged files
        raise damaged_picture(error).with_subject(path) from error


def as_in_file(pixels: NDArray[Any], image: "Image", orientation: int) -> NDArray[Any]:
    """(H, W, C) decoded pixels as they are stored: Pillow applies the orientation of a TIFF, which
    is taken back."""
    return (
        oriented(pixels, {6: 8, 8: 6}.get(orientation, orientation))
        if image.format == "TIFF"
        else pixels
    )


def _seek_full_image(image: "Image") -> None:
    """Go to the first picture of a TIFF that is not marked as a reduced copy of another."""
    if image.format == "TIFF":
        with suppress(EOFError):
            for page in range(MAX_THUMBNAILS):
                image.seek(page)
                if not int(image.tag_v2.get(_SUBFILE, 0)) & 1:  # type: ignore[attr-defined]
                    return
        raise ImageError("holds thumbnails only; export the picture as JPEG or PNG")


def _exif(image: "Image", data: bytes = b"") -> _Exif:
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
    return _Exif(
        orientation if valid else 1,
        focal if 0 < focal < math.inf else None,
        (height, width) if width > 0 and height > 0 else None,
        zoom if focal > 0 else 1.0,
        any(_PANORAMA.search(part) for part in (data[:MAX_METADATA_BYTES], _xmp(image))),
    )


def _xmp(image: "Image") -> bytes:
    """The XMP of a picture that Pillow has found."""
    found = image.info.get("xmp", b"")
    return found if isinstance(found, bytes) else str(found).encode()


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
    return float(directory[_FOCAL]) * _DIAGONAL_35MM / diagonal


def _rgb_pixels(image: "Image", data: bytes) -> tuple[NDArray[np.uint8], tuple[str, ...]]:
    """(H, W, 3), and notes; the largest value that the file's format can hold becomes 255, but of
    16 bits of which the upper ones are empty, as cameras of 10 and 12 bits write them, the largest
    of the used bits."""
    if image.mode.startswith("I;16") or (image.mode == "I" and image.format in ("PNG", "PPM")):
        tags = getattr(image, "tag_v2", {})
        bits = tags.get(_BITS, (16,))[0]
        grey = np.asarray(image).astype(np.uint32)
        # Pillow inverts 8 bits only
        grey = 2**bits - 1 - grey if tags.get(_PHOTOMETRIC) == 0 else grey
        # PGM names its largest value
        used = _used_bits(grey, bits) if image.format != "PPM" else bits
        return np.repeat(_eight_bits(grey, used)[..., None], 3, axis=2), _stretched(used, bits)
    if image.mode in ("I", "F", "LAB", "HSV"):
        kind = {"I": "32 bits", "F": "floating values"}.get(image.mode, f"CIE{image.mode}")
        raise ImageError(
            f"expected RGB or grey of 8 or 16 bits per channel, got {kind}; save it as PNG"
        )
    if image.mode == "P" and image.has_transparency_data:
        image = image.convert("RGBA")  # as Pillow asks for
    rgb = np.asarray(image.convert("RGB"))
    upper_bits = USED_BITS[-1] - 8
    if not _is_deep(image, data) or int(rgb.max(initial=0)) >= 2**upper_bits:
        return rgb, ()
    if image.format != "PNG":
        note = (
            f"16 bits, of which the lower ones are used: {len(np.unique(rgb))} levels remain; "
            f"save it as PNG"
        )
        return rgb, (note,)
    # Pillow drops the lower 8 bits of colours.
    how = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    deep = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), how))
    used = _used_bits(deep, 16)
    return _eight_bits(deep[..., ::-1], used), _stretched(used, 16)


def _is_deep(image: "Image", data: bytes) -> bool:
    """Whether a colour picture has 16 bits for each channel, of which Pillow keeps the upper 8;
    False without data."""
    if not data:
        return False
    if image.format == "PNG":
        return data[24:25] == b"\x10"  # of its first chunk
    tags = getattr(image, "tag_v2", {})
    return bool(tags.get(_BITS, (8,))[0] == 16)


def _used_bits(values: NDArray[Any], bits: int) -> int:
    """The bits that hold all values, 8, 10, 12 or 14; ``bits`` of a black picture, and where more
    are needed."""
    largest = int(values.max(initial=0))
    fewer = [used for used in USED_BITS if used < bits and largest < 2**used]
    return fewer[0] if fewer and largest else bits


def _eight_bits(values: NDArray[Any], bits: int) -> NDArray[np.uint8]:
    """Values of ``bits`` bits, rounded to 8."""
    largest = 2**bits - 1
    rounded: NDArray[np.uint8] = (
        (values.astype(np.uint32) * 255 + largest // 2) // largest
    ).astype(np.uint8)
    return rounded


def _stretched(used: int, bits: int) -> tuple[str, ...]:
    return (f"{bits} bits, of which the lower {used} are used: stretched",) if used < bits else ()


def _notes(image: "Image") -> tuple[str, ...]:
    notes = {
        "grey: three equal channels": image.mode in ("1", "L", "LA", "I")
        or image.mode.startswith("I;16"),
        "CMYK converted to RGB without a colour profile": image.mode == "CMYK",
        "alpha channel dropped": image.has_transparency_data,
        # previews of phones
        ANIMATED: getattr(image, "is_animated", False) and image.format != "MPO",
    }
    return tuple(text for text, applies in notes.items() if applies)


def oriented(x: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Stored (H, W, C) pixels as viewers show them, for an EXIF orientation."""
    x = x[:: -1 if orientation in (3, 4, 6, 7) else 1, :: -1 if orientation in (2, 3, 7, 8) else 1]
    return x.swapaxes(0, 1) if orientation > 4 else x


_CONTAINERS = re.compile(
    rb"RIFF....AVI |....(ftyp|moov|mdat|wide|free|skip)|\x1a\x45\xdf\xa3|\0\0\1[\xba\xb3]|\x47.{187}\x47",  # noqa: E501
    re.DOTALL,
)
"""Starts of AVI, MP4 and QuickTime, Matroska and WebM, and MPEG files. Text that FFmpeg reads as a
playlist, such as ``ffconcat``, would make it open other files."""


class Video:
    """The frames of a video, decoded one after the other: pairs of a frame's number and its (3, H,
    W) uint8 RGB pixels.

    Args:
        path: an AVI, MP4, MOV, MKV, WebM or MPEG file in a format that OpenCV decodes.
        every: step between the frames that are yielded, >= 1.

    Attributes:
        fps: frames per second of the file.
        count: number of frames that it announces; some files announce a wrong one.

    Raises:
        ImageError: not a video, or one beyond :mod:`curvireg_torch.errors`; while iterating, a
            frame that cannot be decoded, or a video without frames.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "two.avi")
        >>> writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
        >>> _ = [writer.write(np.zeros((48, 64, 3), np.uint8)) for _ in range(2)]
        >>> writer.release()
        >>> video = Video(file)
        >>> video.fps, [(number, image.shape) for number, image in video]
        (25.0, [(0, torch.Size([3, 48, 64])), (1, torch.Size([3, 48, 64]))])
    """

    def __init__(self, path: Path, *, every: int = 1) -> None:
        self.path = path
        self.every = check_integer(every, "every")
        file = self._open()
        self.fps = float(file.get(cv2.CAP_PROP_FPS))
        self.count = int(file.get(cv2.CAP_PROP_FRAME_COUNT))
        file.release()

    def __iter__(self) -> Iterator[tuple[int, Tensor]]:
        for number, file in self._grabbed():
            known, pixels = file.retrieve()
            if not known:
                raise ImageError(
                    f"frame {number} cannot be read; save the video again", subject=self.path
                )
            yield (
                number,
                torch.from_numpy(np.ascontiguousarray(pixels[..., ::-1].transpose(2, 0, 1))),
            )

    def numbers(self) -> list[int]:
        """Return the numbers of the frames that are yielded, which are counted: ``count`` may be
        wrong."""
        return [number for number, _ in self._grabbed()]

    def _grabbed(self) -> Iterator[tuple[int, cv2.VideoCapture]]:
        """Yield each frame's number, and the file that it can be retrieved from."""
        file = self._open()
        number = 0
        try:
            while file.grab():
                if number % self.every == 0:
                    yield number, file
                number += 1
            if number == 0:
                raise ImageError("a video without frames; save it again", subject=self.path)
        finally:
            file.release()

    def _open(self) -> cv2.VideoCapture:
        message = "not a video that can be read; save it as MP4 (H.264), or give its frames"
        try:
            with self.path.open("rb") as stream:
                known = _CONTAINERS.match(stream.read(256))
        except OSError as error:
            raise ImageError(f"cannot be read ({error.strerror})", subject=self.path) from error
        if known is None:
            raise ImageError(message, subject=self.path)
        file = cv2.VideoCapture(str(self.path))
        width, height = (
            int(file.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        if not file.isOpened() or not 0 < width * height <= MAX_IMAGE_PIXELS:
            file.release()
            raise ImageError(message, subject=self.path)
        return file
