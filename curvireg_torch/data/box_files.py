"""Boxes in the formats of detectors, and files of them."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InvalidInputError, MissingFileError
from ..utils.choices import BOX_FORMATS
from ..utils.files import check_table_size, finite_numbers, read_json, split_name
from .images import photo_size

README = "docs/guides/boxes.md"
# px from the picture's edge, where detectors count from, to the centre of its first pixel
EDGE = 0.5

Box = tuple[float, float, float, float]


def pixel_box(
    numbers: Sequence[float], box_format: str, size: tuple[int, int] | None = None
) -> Box:
    """x0, y0, x1, y1 in px of the four numbers of a box.

    Args:
        numbers: the box.
        box_format: "xyxy", as they are; "xywh": x0, y0, width, height in px; "fractions": x0, y0,
            x1, y1 in fractions of the picture; "yolo": centre x, y, width, height in fractions.
        size: (H, W) of the photograph, for fractions.

    Example:
        >>> pixel_box((0.5, 0.5, 0.5, 0.25), "yolo", (480, 640))
        (159.5, 179.5, 479.5, 299.5)
    """
    a, b, c, d = numbers
    if box_format == "xyxy":
        return a, b, c, d
    if box_format == "xywh":
        return a, b, a + c, b + d
    if size is None:
        raise InvalidInputError(f"box: {box_format} of a photograph, not of a video; give px")
    if box_format == "yolo":
        a, b, c, d = a - c / 2, b - d / 2, a + c / 2, b + d / 2
    if not all(-0.5 <= value <= 1.5 for value in (a, b, c, d)):
        kinds = ", ".join(BOX_FORMATS)
        raise InvalidInputError(
            f"box: expected fractions of the picture from 0 to 1; of px, give another format "
            f"({kinds})"
        )
    H, W = size
    return a * W - EDGE, b * H - EDGE, c * W - EDGE, d * H - EDGE


@dataclass(frozen=True)
class _Detection:
    """A box of a file, its format, its score, and names of what it shows."""

    numbers: tuple[float, ...]
    box_format: str
    score: float
    labels: frozenset[str]


class BoxFile:
    """The boxes of a detector.

    Args:
        path: a JSON file of COCO, of its results or its annotations; ``object_data.json`` of
            MegaPose; a text file of YOLO; or a folder of these, each called as its photograph.
            ``PATH:LABEL`` takes only boxes of this label: its number, or its name.

    Raises:
        MissingFileError: there is no such file or folder.
        InvalidInputError: it is none of these.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> _ = (folder / "boxes.json").write_text('[{"image_id": "a", "bbox": [10, 20, 30, 40], "score": 0.9}]')
        >>> BoxFile(folder / "boxes.json").box(Path("a.jpg"))
        (9.5, 19.5, 39.5, 59.5)
    """  # noqa: E501

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path, self.label = split_name(path)
        self._by_image: dict[str, list[_Detection]] | None = None
        if not self.path.exists():
            raise MissingFileError(
                f"no such file or folder; {README} shows the formats", subject=path
            )
        if self.path.is_file() and self.path.suffix.lower() != ".txt":
            self._by_image = _detections(self.path)

    def box(self, photo: Path) -> Box:
        """x0, y0, x1, y1 in px of the best box of a photograph; :class:`InvalidInputError` if it
        has none."""
        found = self.find(photo)
        if found is None:
            kind = f" of label {self.label!r}" if self.label else ""
            raise InvalidInputError(
                f"no box{kind} in {self.path}; detect it again, or leave the photograph out"
            )
        return found

    def find(self, photo: Path, size: tuple[int, int] | None = None) -> Box | None:
        """:meth:`box`, or None if a photograph has none; of a frame of a video, which is no file,
        with its ``size`` (H, W)."""
        found = self._of(photo)
        if self.label:
            found = [detection for detection in found if self.label in detection.labels]
        if not found:
            return None
        best = max(found, key=lambda detection: detection.score)
        is_relative = best.box_format in ("fractions", "yolo")
        if is_relative and size is None:
            size = photo_size(photo)
        box = pixel_box(best.numbers, best.box_format, size)
        if best.box_format != "xywh":
            return box
        x0, y0, x1, y1 = (value - EDGE for value in box)
        return x0, y0, x1, y1

    def _of(self, photo: Path) -> list[_Detection]:
        if self._by_image is None:
            file = self.path / f"{photo.stem}.txt" if self.path.is_dir() else self.path
            return _yolo(file) if file.is_file() else []
        names = [
            photo.name,
            photo.stem,
            "",
            *([str(int(photo.stem))] if photo.stem.isdecimal() else []),
        ]
        scene = photo.parent.parent.name  # of BOP: scene/rgb/image
        if scene.isdecimal():
            names = [f"{int(scene)}/{name}" for name in names] + names
        return next((self._by_image[name] for name in names if name in self._by_image), [])


def _yolo(file: Path) -> list[_Detection]:
    """Lines of a label, the centre, width and height in fractions of the picture, and perhaps a
    score."""
    check_table_size(file)
    found = []
    for count, line in enumerate(
        file.read_text(encoding="utf-8", errors="replace").splitlines(), start=1
    ):
        words = line.split()
        if not words:
            continue
        try:
            numbers = tuple(map(float, words[1:]))
        except ValueError:
            numbers = ()
        if len(numbers) not in (4, 5) or not all(map(math.isfinite, numbers)):
            message = (
                f"line {count}: expected CLASS CX CY WIDTH HEIGHT [SCORE] of YOLO; "
                f"{README} shows "
                f"the formats"
            )
            raise InvalidInputError(message, subject=file)
        score = numbers[4] if len(numbers) == 5 else 1.0
        found.append(_Detection(numbers[:4], "yolo", score, frozenset(words[:1])))
    return found


def _detections(file: Path) -> dict[str, list[_Detection]]:
    """The boxes of a JSON file, by the image's number, name and stem; "" of a file of one
    photograph."""
    content = read_json(file, (dict, list), README)
    items = content
    names = {}
    categories = {}
    if isinstance(content, dict):
        items = content.get("annotations")
        names = _names(content.get("images"), "file_name")
        categories = _names(content.get("categories"), "name")
    if not isinstance(items, list):
        raise InvalidInputError(
            f"expected detections of COCO; {README} shows the formats", subject=file
        )
    found: dict[str, list[_Detection]] = {}
    for index, item in enumerate(items):
        key = next(
            (key for key in ("bbox", "bbox_modal") if isinstance(item, dict) and key in item), ""
        )
        numbers = finite_numbers(item[key], 4) if key else None
        if numbers is None:
            message = f"entry {index}: expected bbox of 4 numbers; {README} shows the formats"
            raise InvalidInputError(message, subject=file)
        category = str(item.get("category_id", ""))
        labels = {category, str(item.get("label", "")), categories.get(category, "")} - {""}
        score = finite_numbers([item.get("score", 1.0)], 1) or (0.0,)
        detection = _Detection(
            numbers, "xyxy" if key == "bbox_modal" else "xywh", score[0], frozenset(labels)
        )
        for name in _image_names(item, names):
            found.setdefault(name, []).append(detection)
    return found


def _names(entries: Any, key: str) -> dict[str, str]:
    """The ``key`` of entries with an ``id``."""
    known = (
        [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []
    )
    return {str(entry.get("id")): str(entry.get(key, "")) for entry in known}


def _image_names(item: Mapping[str, Any], names: Mapping[str, str]) -> set[str]:
    """The names by which a photograph of a detection is found."""
    image = str(item.get("image_id", ""))
    name = names.get(image, image).replace("\\", "/")
    found = {Path(name).name, Path(name).stem} if name else {""}
    scene = item.get("scene_id")
    return {f"{scene}/{one}" for one in found} if scene is not None else found
