"""Frames of videos."""

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import MAX_IMAGE_PIXELS, ImageError
from ..utils.checks import check_integer

_CONTAINERS = re.compile(
    rb"RIFF....AVI |....(ftyp|moov|mdat|wide|free|skip)|\x1a\x45\xdf\xa3|\0\0\1[\xba\xb3]|\x47.{187}\x47", re.DOTALL
)
"""Starts of AVI, MP4 and QuickTime, Matroska and WebM, and MPEG files. Text that FFmpeg reads as a playlist, such as
``ffconcat``, would make it open other files."""


class Video:
    """The frames of a video, decoded one after the other: pairs of a frame's number and its (3, H, W) uint8 RGB pixels.

    Args:
        path: an AVI, MP4, MOV, MKV, WebM or MPEG file in a format that OpenCV decodes.
        every: step between the frames that are yielded, >= 1.

    Attributes:
        fps: frames per second of the file.
        count: number of frames that it announces; some files announce a wrong one.

    Raises:
        ImageError: not a video, or one beyond :mod:`curvireg_torch.errors`; while iterating, a frame that cannot be
            decoded, or a video without frames.

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
        self.path, self.every = path, check_integer(every, "every")
        file = self._open()
        self.fps, self.count = float(file.get(cv2.CAP_PROP_FPS)), int(file.get(cv2.CAP_PROP_FRAME_COUNT))
        file.release()

    def __iter__(self) -> Iterator[tuple[int, Tensor]]:
        file, number = self._open(), 0
        try:
            while file.grab():
                if number % self.every == 0:
                    known, pixels = file.retrieve()
                    if not known:
                        raise ImageError(f"frame {number} cannot be read; save the video again", subject=self.path)
                    yield number, torch.from_numpy(np.ascontiguousarray(pixels[..., ::-1].transpose(2, 0, 1)))
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
        width, height = (int(file.get(k)) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not file.isOpened() or not 0 < width * height <= MAX_IMAGE_PIXELS:
            file.release()
            raise ImageError(message, subject=self.path)
        return file
