"""Photographs from disk."""

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import MAX_IMAGE_BYTES, MAX_IMAGE_PIXELS, MAX_IMAGE_SCANS, ImageError, InvalidInputError, MissingFileError
from ..geometry.cameras import camera_matrix
from ..utils.checks import check_option
from .image_headers import ImageHeader, read_header

_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_APPLY_ORIENTATION = {  # stored (H, W, C) pixels to viewed ones, for each EXIF orientation
    1: lambda x: x,
    2: lambda x: x[:, ::-1],
    3: lambda x: x[::-1, ::-1],
    4: lambda x: x[::-1],
    5: lambda x: x.swapaxes(0, 1),
    6: lambda x: x[::-1].swapaxes(0, 1),
    7: lambda x: x[::-1, ::-1].swapaxes(0, 1),
    8: lambda x: x[:, ::-1].swapaxes(0, 1),
}


@dataclass(frozen=True)
class Photo:
    """A photograph as viewers show it, and the metadata of its file.

    Attributes:
        image: (3, H, W) RGB.
        orientation: the EXIF orientation that was applied, 1 to 8; 1 = none.
        focal_35mm: EXIF focal length in mm of a 36 x 24 mm camera of the same view, or None.
        notes: changes to the pixels, in words.
    """

    image: Tensor
    orientation: int
    focal_35mm: float | None
    notes: tuple[str, ...]

    def guessed_camera_matrix(self) -> Tensor | None:
        """(3, 3) float64 camera matrix from the EXIF focal length, or None without one.

        The focal length is relative to the diagonal, the principal point the centre: the picture must not be cropped.
        """
        if self.focal_35mm is None:
            return None
        H, W = self.image.shape[-2:]
        focal = self.focal_35mm * math.hypot(H, W) / _DIAGONAL_35MM
        return camera_matrix(focal, focal, (W - 1) / 2, (H - 1) / 2, dtype=torch.float64)

    def facts(self) -> dict[str, Any]:
        """All but the pixels, as plain JSON."""
        return {
            "width": self.image.shape[-1],
            "height": self.image.shape[-2],
            "orientation": self.orientation,
            "focal_35mm": self.focal_35mm,
            "notes": list(self.notes),
        }


def read_photo(path: str | os.PathLike[str], *, dtype: torch.dtype = torch.uint8) -> Photo:
    """Read a photograph as viewers show it: the EXIF orientation is applied, and boxes refer to the result.

    Args:
        path: JPEG, PNG, TIFF, WebP, BMP, PGM or PPM with 8 or 16 bits per channel.
        dtype: ``torch.uint8``, 0 to 255, or ``torch.float32``, 0 to 1.

    Raises:
        MissingFileError: the file does not exist.
        ImageError: another format or bit depth, a truncated file, or one beyond :mod:`curvireg_torch.errors`.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "grey.png")
        >>> cv2.imwrite(str(file), np.full((4, 6), 51, np.uint8))
        True
        >>> photo = read_photo(file)
        >>> photo.image.shape, int(photo.image[0, 0, 0]), photo.notes
        (torch.Size([3, 4, 6]), 51, ('grey: three equal channels',))
    """
    header, pixels = _decode(Path(path))
    orientation = header.exif.orientation
    notes = _notes(header, pixels.dtype, dtype)
    return Photo(_to_tensor(_APPLY_ORIENTATION[orientation](pixels), dtype), orientation, header.exif.focal_35mm, notes)


def read_image(
    path: str | os.PathLike[str], *, orientation: str = "stored", dtype: torch.dtype = torch.float32
) -> Tensor:
    """Read a photograph as (3, H, W) RGB; ``path``, ``dtype`` and errors as in :func:`read_photo`.

    Grey images get three equal channels, an alpha channel is dropped, 16-bit images keep their precision in float32.

    Args:
        orientation: ``"stored"``, to which the boxes of datasets refer, or ``"viewed"`` to apply that of EXIF.
    """
    check_option(orientation, ("stored", "viewed"), "orientation")
    header, pixels = _decode(Path(path))
    return _to_tensor(_APPLY_ORIENTATION[header.exif.orientation](pixels) if orientation == "viewed" else pixels, dtype)


def _decode(path: Path) -> tuple[ImageHeader, NDArray[Any]]:
    """Header and (H, W, 3) BGR pixels, uint8 or uint16, as stored."""
    if not path.is_file():
        raise MissingFileError("no such file; check the path of the photograph", subject=path)
    if path.stat().st_size > MAX_IMAGE_BYTES:
        raise ImageError(f"larger than {MAX_IMAGE_BYTES:,} bytes; save it smaller", subject=path)
    try:
        header = read_header(path.read_bytes())
    except ValueError as error:
        raise ImageError(str(error), subject=path) from None
    size = f"{header.width} x {header.height} px"
    if header.width * header.height > MAX_IMAGE_PIXELS:
        raise ImageError(f"{size}, more than {MAX_IMAGE_PIXELS:,} pixels; scale it down", subject=path)
    if header.scans > MAX_IMAGE_SCANS:
        raise ImageError(f"a JPEG of {header.scans} scans, more than {MAX_IMAGE_SCANS}; save it again", subject=path)
    pixels = _decode_silently(header.data)
    if pixels is None or pixels.shape != (header.height, header.width, 3):
        raise ImageError(
            f"not an image that can be decoded ({size}, {header.colour}, {header.bits} bits); "
            "save it as JPEG or PNG with 8 or 16 bits per channel",
            subject=path,
        )
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"expected 8 or 16 bits per channel, got {pixels.dtype}; save it as PNG", subject=path)
    return header, pixels


def _decode_silently(data: bytes) -> NDArray[Any] | None:
    """OpenCV's pixels, or None; its log is off, because the caller reports the failure."""
    log = getattr(cv2.utils, "logging", cv2)  # OpenCV 5, and 4
    level = log.getLogLevel()
    try:
        log.setLogLevel(0)
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        pixels: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        return pixels
    except cv2.error:
        return None
    finally:
        log.setLogLevel(level)


def _to_tensor(bgr: NDArray[Any], dtype: torch.dtype) -> Tensor:
    rgb = bgr[..., ::-1].transpose(2, 0, 1)
    if dtype == torch.uint8:
        rounded = (rgb.astype(np.uint32) + 128) // 257 if bgr.dtype == np.uint16 else rgb
        return torch.from_numpy(np.ascontiguousarray(rounded, dtype=np.uint8))
    if dtype != torch.float32:
        raise InvalidInputError(f"dtype: expected torch.uint8 or torch.float32, got {dtype}")
    return torch.from_numpy(np.ascontiguousarray(rgb, dtype=np.float32)).div_(float(np.iinfo(bgr.dtype).max))


def _notes(header: ImageHeader, stored: np.dtype[Any], dtype: torch.dtype) -> tuple[str, ...]:
    notes = {
        f"EXIF orientation {header.exif.orientation} applied": header.exif.orientation != 1,
        "grey: three equal channels": header.colour == "grey",
        "CMYK converted to RGB without a colour profile": header.colour == "CMYK",
        "alpha channel dropped": header.alpha,
        "16 bits rounded to 8": stored == np.uint16 and dtype == torch.uint8,
        "first of several pictures": header.has_more_pages,
        f"{header.surplus:,} bytes after the picture ignored": header.surplus > 0,
    }
    return tuple(text for text, applies in notes.items() if applies)
