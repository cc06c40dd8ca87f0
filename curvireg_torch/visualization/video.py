"""A video of the poses of a followed object."""

import math
import warnings
from contextlib import AbstractContextManager
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import OutputError
from ..registration import FailedRegistration, Registrar, Registration
from ..registration.confidence import two_decimals
from ..utils.arrays import Bytes
from .contours import Drawn, draw_window
from .overlay import VERDICT_COLOURS

LARGEST_CLOCK = 65535  # MPEG-4: of frames a second times a power of ten that makes them whole
_LONGER_SIDE = 960  # of the frames in px; larger ones are scaled down


class OverlayVideo(AbstractContextManager["OverlayVideo"]):
    """Writes frames with the contours of the mesh at the pose, and the confidence in words, to an
    MP4 file.

    The file is complete only after :meth:`close`; as a context manager, the video closes itself,
    whatever happens.

    Args:
        path: of the file, which ends in ``.mp4``.
        registrar: whose mesh is drawn.
        fps: frames per second.

    Example:
        >>> import tempfile
        >>> import curvireg_torch as cr
        >>> from curvireg_torch.synthetic import example_mesh
        >>> bank = cr.ViewBank.build(example_mesh(), cr.sample_views(azimuth_step=90),
        ...     image_size=64, progress=False)
        >>> registrar, image = cr.Registrar(bank), torch.rand(3, 120, 160)
        >>> with OverlayVideo(Path(tempfile.mkdtemp(), "overlay.mp4"), registrar,
        ...     fps=10.0) as video:
        ...     video.add(image, registrar([image], [[40, 30, 120, 90]], cr.camera_matrix(150, 150,
        ...     79.5, 59.5))[0])
        >>> video.path.name
        'overlay.mp4'
    """

    def __init__(self, path: Path, registrar: Registrar, *, fps: float) -> None:
        self.path = path
        self.registrar = registrar
        self.fps = fps
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self._count = 0
        self._waiting: list[Registration | FailedRegistration] = []

    def add(self, image: Tensor | None, result: Registration | FailedRegistration) -> None:
        """Draw and write the next frame: (1 or 3, H, W), or None if it could not be read.

        All frames get the size of the first one that could, for which those before it wait.
        """
        if image is None and self._writer is None:
            self._waiting.append(result)
            return
        if image is None:
            image = torch.zeros(3, self._size[1], self._size[0], dtype=torch.uint8)
        picture = annotated_frame(self.registrar, image, result)
        if self._writer is None:
            self._writer = self._open(picture)
            for earlier in self._waiting:
                self.add(None, earlier)
        if picture.shape[1::-1] != self._size:
            picture = np.asarray(cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA))
        self._writer.write(picture[..., ::-1])
        self._count += 1

    def _open(self, picture: Bytes) -> cv2.VideoWriter:
        # the codec needs even numbers
        self._size = (picture.shape[1] // 2 * 2, picture.shape[0] // 2 * 2)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fps = round(self.fps, int(math.log10(LARGEST_CLOCK / self.fps)))
        writer = cv2.VideoWriter(str(self.path), cv2.VideoWriter.fourcc(*"mp4v"), fps, self._size)
        if not writer.isOpened():
            warnings.warn("this OpenCV has no MPEG-4 encoder; no overlay is written", stacklevel=3)
        return writer

    def close(self) -> None:
        """Finish the file. Nothing is written if there was no frame.

        Raises:
            OutputError: the file is not whole, as on a full disk.
        """
        if self._writer is None:
            return
        is_opened = self._writer.isOpened()
        self._writer.release()
        self._writer = None
        if is_opened and (readable := _frames_in(self.path)) != self._count:
            raise OutputError(
                f"cannot be written whole ({readable} of {self._count} frames can be read); make "
                f"room",
                subject=self.path,
            )

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except OutputError:
            if kind in (None, KeyboardInterrupt):  # another error counts more
                raise


def _frames_in(path: Path) -> int:
    """The number of frames that a video has by its index; 0 of a file that cannot be read."""
    return max(0, int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT)))


def annotated_frame(
    registrar: Registrar, image: Tensor, result: Registration | FailedRegistration
) -> Bytes:
    """(H, W, 3) uint8 of the image, of at most 960 px, with the mesh's contours if there is a pose,
    and a caption."""
    H, W = image.shape[-2:]
    scale = min(1.0, _LONGER_SIDE / max(H, W))
    objects = []
    if isinstance(result, Registration):
        describer = registrar.of_mesh(result.mesh_index).describer
        objects = [Drawn(describer, result.projection)]
    picture = draw_window(image, (0, 0, W, H), scale, objects)
    text, colour = caption(result)
    scale = max(0.4, picture.shape[1] / 1200)
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    cv2.rectangle(picture, (0, 0), (width + 12, height + below + 6), colour, cv2.FILLED)
    corner = (6, height + 4)
    white = (255, 255, 255)
    cv2.putText(picture, text, corner, cv2.FONT_HERSHEY_SIMPLEX, scale, white, 1, cv2.LINE_AA)
    return picture


def caption(result: Registration | FailedRegistration) -> tuple[str, tuple[int, int, int]]:
    """How sure the result is, in words and as a colour."""
    if isinstance(result, FailedRegistration):
        return result.verdict, VERDICT_COLOURS["no match"]
    word = result.verdict
    number = "" if result.confidence is None else f", confidence {two_decimals(result.confidence)}"
    return word + number, VERDICT_COLOURS[word]
