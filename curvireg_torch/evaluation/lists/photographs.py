"""Lists of photographs from files, folders, patterns and videos."""

import glob
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...data import Video
from ...errors import InvalidInputError, MissingFileError
from ...utils.choices import IMAGES, VIDEOS
from ...utils.files import write_file
from ...utils.input_paths import is_pattern
from ...visualization.encoding import png
from ...visualization.overlay import to_uint8
from .entries import BOX, CAMERA, PhotoList, photo_list

__all__ = ["list_photographs"]


def list_photographs(
    paths: Sequence[Path],
    meshes: Sequence[Path],
    *,
    box: Sequence[float] | None = None,
    camera: Sequence[float] | None = None,
    limits: Mapping[str, Any] | None = None,
    every: int = 1,
    frames: Path,
) -> PhotoList:
    """List photographs that have the same box, camera and limits on the pose.

    Args:
        paths: photographs, folders of them, patterns such as ``shots/*.jpg``, videos.
        meshes: mesh files; of several the best is found.
        box, camera: x0, y0, x1, y1 (default: the object is detected) and fx, fy, cx, cy, in px.
        limits: arguments of :class:`PosePrior`.
        every, frames: use every n-th frame of videos; folder for these, as PNG.

    Raises:
        MissingFileError: a pattern or folder without photographs.
        ImageError: a video that cannot be read.
    """
    if every < 1:
        raise InvalidInputError(f"--every: expected >= 1, got {every}")
    numbers = [text for four in (box, camera) for text in (map(str, four) if four else [""] * 4)]
    rows = [[str(photo), *numbers] for path in paths for photo in _found(path, every, frames)]
    return photo_list("photographs", ["photo", *BOX, *CAMERA], rows, Path(), meshes, limits)


def _found(path: Path, every: int, frames: Path) -> Iterator[Path]:
    if path.suffix.lower() in VIDEOS and path.is_file():
        yield from _frames(path, every, frames)
    elif path.is_dir() or is_pattern(path):
        inside = path.iterdir() if path.is_dir() else map(Path, glob.glob(str(path), recursive=True))
        photographs = sorted(found for found in inside if found.suffix.lower() in IMAGES and found.is_file())
        if not photographs:
            raise MissingFileError(f"{path}: no photographs ({', '.join(IMAGES)}); check the path")
        yield from photographs
    else:
        yield path


def _frames(path: Path, every: int, folder: Path) -> Iterator[Path]:
    """Write frames 0, every, 2 every, ... as files."""
    for number, image in Video(path, every=every):
        frame = folder / f"{path.stem}-{number:06d}.png"
        write_file(frame, png(to_uint8(image)))
        yield frame
