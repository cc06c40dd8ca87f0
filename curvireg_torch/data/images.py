"""Photographs from disk."""

import os
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import ImageError, MissingFileError

__all__ = ["read_image"]


def read_image(path: str | os.PathLike[str]) -> Tensor:
    """Read a photograph as RGB.

    The pixels come as they are stored: an EXIF orientation tag is ignored, because labelled boxes count in stored
    pixels. Grey images get three equal channels, an alpha channel is dropped, 16-bit images keep their precision.

    Args:
        path: any format that OpenCV reads, with 8 or 16 bits per channel.

    Returns:
        (3, H, W) float32 in [0, 1].

    Raises:
        MissingFileError: no such file.
        ImageError: not an image, truncated, or of another bit depth.

    Example:
        >>> read_image("missing.jpg")
        Traceback (most recent call last):
        ...
        curvireg_torch.errors.MissingFileError: missing.jpg: no such file; check the path of the photograph
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"{path}: no such file; check the path of the photograph")
    data = path.read_bytes()
    if _is_truncated(data):
        raise ImageError(f"{path}: the image is truncated; fetch the file again")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:
        bgr = None
    if bgr is None:
        raise ImageError(f"{path}: not an image that OpenCV can read")
    if bgr.dtype not in (np.uint8, np.uint16):
        raise ImageError(f"{path}: expected 8 or 16 bits per channel, got {bgr.dtype}")
    rgb = np.ascontiguousarray(bgr[..., ::-1].transpose(2, 0, 1), dtype=np.float32)
    return torch.from_numpy(rgb) / float(np.iinfo(bgr.dtype).max)


def _is_truncated(data: bytes) -> bool:
    """Whether the end mark of a JPEG or PNG is missing: OpenCV fills the lost part with grey and says nothing."""
    if data.startswith(b"\xff\xd8"):  # JPEG: an end of image must follow the last start of scan
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-1024:]
    return False
