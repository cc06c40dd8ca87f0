"""Photographs and frames of videos from disk."""

import math
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import MAX_IMAGE_PIXELS, CurviregWarning, ImageError
from ..formats.pictures import (
    DIAGONAL_35MM,
    Metadata,
    as_in_file,
    opened_picture,
    oriented,
    picture_metadata,
)
from ..geometry.calibration import Camera
from ..geometry.cameras import camera_matrix
from ..utils.aliases import Fields, PathName, Size
from ..utils.arrays import Array, Bytes
from ..utils.checks import check_integer
from ..utils.pictures import check_pixels, decoding

if TYPE_CHECKING:
    from PIL.Image import Image


_PHOTOMETRIC = 262
_BITS = 258

USED_BITS = (8, 10, 12, 14)  # of cameras that write 16


EXIF_DEVIATION = 0.05
"""Standard deviation of an EXIF focal length: it is rounded to whole millimetres, lens corrections
and stabilisers cut the border off, and some cameras mean the width by it, not the diagonal. An
estimate, not measured."""


ANIMATED = "one of several pictures"
"""Note about the first picture of an animation, or of a file of several."""

# Longer side over the shorter one beyond which a picture is a panorama, or a strip of another one
PANORAMA_PROPORTIONS = 2.5

# of the frames that a video announces, which some do a little wrong: one with fewer was cut
LEAST_FRAMES = 0.9


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
        >>> photo = Photo(torch.zeros(3, 48, 64, dtype=torch.uint8), focal_35mm=28.0)
        >>> round(float(photo.camera().matrix[0, 0]))
        52
    """

    image: Tensor
    orientation: int = 1
    focal_35mm: float | None = None
    notes: tuple[str, ...] = ()
    taken_size: Size | None = None
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
        if self.taken_size is None:
            return False
        longer = max(self.image.shape[-2:])
        shorter = min(self.image.shape[-2:])
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
        focal *= math.hypot(*taken) / DIAGONAL_35MM
        return camera_matrix(focal, focal, (W - 1) / 2, (H - 1) / 2)

    def camera(self) -> Camera | None:
        """Return the camera of :meth:`guessed_camera_matrix`, or None."""
        K = self.guessed_camera_matrix()
        deviation = math.hypot(EXIF_DEVIATION, math.log(self.digital_zoom) / 2)
        return None if K is None else Camera(K, focal_deviation=deviation, source="exif")

    def facts(self) -> Fields:
        """Return all but the pixels, as plain JSON."""
        return {
            "width": self.image.shape[-1],
            "height": self.image.shape[-2],
            "orientation": self.orientation,
            "focal_35mm": self.focal_35mm,
            "notes": list(self.notes),
        }


def read_photo(path: PathName, *, as_stored: bool = False) -> Photo:
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
    with opened_picture(Path(path)) as (image, _, data):
        found = _decoded(image, data)
    return _photo(*found, as_stored=as_stored)


def photo_of_picture(image: "Image") -> Photo:
    """A picture that Pillow has opened, as :func:`read_photo` reads its file; of one made in
    memory, its pixels.

    Raises:
        ImageError: a mode that is not read, a damaged file, or one beyond
            :mod:`curvireg_torch.errors`.
    """
    with decoding():
        check_pixels(image)
        return _photo(*_decoded(image, b""))


def _photo(
    rgb: Bytes, exif: "Metadata", notes: tuple[str, ...], *, as_stored: bool = False
) -> Photo:
    orientation = 1 if as_stored else exif.orientation
    if orientation != 1:
        notes = (f"EXIF orientation {orientation} applied", *notes)
    if exif.digital_zoom > 1.0:
        notes = (*notes, f"digital zoom {exif.digital_zoom:.3g}: perhaps not in the focal length")
    pixels = torch.from_numpy(np.array(oriented(rgb, orientation).transpose(2, 0, 1), order="C"))
    shown = exif._replace(orientation=orientation)
    return Photo(pixels, notes=notes, **shown._asdict())


def read_image(path: PathName) -> Tensor:
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


def _decoded(image: "Image", data: bytes) -> tuple[Bytes, Metadata, tuple[str, ...]]:
    """(H, W, 3) RGB pixels as stored, metadata, and notes."""
    notes = _notes(image)
    exif = picture_metadata(image, data)
    rgb, stretched = _rgb_pixels(image, data)
    return as_in_file(rgb, image, exif.orientation), exif, (*notes, *stretched)


def _rgb_pixels(image: "Image", data: bytes) -> tuple[Bytes, tuple[str, ...]]:
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


def _used_bits(values: Array, bits: int) -> int:
    """The bits that hold all values, 8, 10, 12 or 14; ``bits`` of a black picture, and where more
    are needed."""
    largest = int(values.max(initial=0))
    fewer = [used for used in USED_BITS if used < bits and largest < 2**used]
    return fewer[0] if fewer and largest else bits


def _eight_bits(values: Array, bits: int) -> Bytes:
    """Values of ``bits`` bits, rounded to 8."""
    largest = 2**bits - 1
    return np.asarray((values.astype(np.uint32) * 255 + largest // 2) // largest, np.uint8)


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


def frame_tensor(pixels: Array) -> Tensor:
    """(3, H, W) RGB of a frame (H, W, 3) as OpenCV has it."""
    return torch.from_numpy(np.ascontiguousarray(pixels[..., ::-1].transpose(2, 0, 1)))


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
            yield number, frame_tensor(pixels)

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
            if number < LEAST_FRAMES * self.count:
                cut = f"{self.path}: ends after {number} of {self.count} frames; copy it again"
                warnings.warn(cut, CurviregWarning, stacklevel=2)
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
