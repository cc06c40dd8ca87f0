"""Frames of a video by their number, without a copy of each on disk."""

import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from torch import Tensor

from ..errors import ImageError
from .images import Video

MAX_SHARED = 4  # videos that a process of workers keeps open


class FrameReader:
    """Frames of one video, which is decoded once for numbers that are asked for in order.

    Args:
        path: of the video, see :class:`Video`.
        every: step between the frames that can be read, from 0.

    Example:
        >>> import tempfile
        >>> import cv2, numpy as np
        >>> file = Path(tempfile.mkdtemp(), "two.avi")
        >>> writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
        >>> _ = [writer.write(np.zeros((48, 64, 3), np.uint8)) for _ in range(2)]
        >>> writer.release()
        >>> FrameReader(file).read(1).shape
        torch.Size([3, 48, 64])
    """

    def __init__(self, path: Path, *, every: int = 1) -> None:
        self.path = path
        self.every = every
        self._frames: Iterator[tuple[int, Tensor]] = iter(())
        self._last = math.inf  # none is open
        self._error: ImageError | None = None

    def __reduce__(self) -> tuple[object, ...]:
        """A process decodes each video once, whatever number of frames it gets of it."""
        return _shared_reader, (self.path, self.every)

    def read(self, number: int) -> Tensor:
        """(3, H, W) uint8 RGB of a frame; :class:`ImageError` if it cannot be decoded."""
        if self._error is not None:  # what follows a damaged frame is not decoded again for each
            raise self._error
        if number <= self._last:
            self._frames = iter(Video(self.path, every=self.every))
        try:
            for decoded, image in self._frames:
                self._last = decoded
                if decoded == number:
                    return image
        except ImageError as error:
            self._error = error
            raise
        raise ImageError(f"no frame {number}", subject=self.path)


@lru_cache(MAX_SHARED)
def _shared_reader(path: Path, every: int) -> FrameReader:
    return FrameReader(path, every=every)
