"""The box of a photograph, in px, among those of a file or a folder."""

import os
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from ...errors import CurviregWarning, InvalidInputError, MissingFileError
from ...utils.aliases import PathName, Size
from ...utils.choices import listed
from ...utils.files import split_name, without_zeros
from .files import (
    ANY_FOLDER,
    ID_LABEL,
    PIXEL_CENTRE,
    README,
    SUFFIXES,
    Corners,
    ImageBox,
    read_boxes,
)

MAX_FOLDERS = 8  # around a photograph by which it is told from others of its name


class PictureSize(NamedTuple):
    """(H, W) of a photograph as viewers show it, and its EXIF orientation, 1 to 8."""

    shown: Size
    orientation: int = 1

    @property
    def stored(self) -> Size:
        """(H, W) of the pixels in the file."""
        return self.shown[::-1] if self.orientation > 4 else self.shown


def pixel_box(numbers: Sequence[float], box_format: str, size: Size | None = None) -> Corners:
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
    return _of_fractions((a, b, c, d), size)


def _of_fractions(corners: Corners, size: Size) -> Corners:
    if not all(-0.5 <= value <= 1.5 for value in corners):
        raise InvalidInputError(
            "box: expected fractions of the picture from 0 to 1; divide px by its size"
        )
    height, width = size
    return _from_centre(corners, width, height)


def _from_centre(corners: Corners, x: float = 1.0, y: float = 1.0) -> Corners:
    """px that count from the centre of the first pixel, of corners from the picture's edge in x by
    y px."""
    x0, y0, x1, y1 = corners
    edge = PIXEL_CENTRE
    return x0 * x - edge, y0 * y - edge, x1 * x - edge, y1 * y - edge


class BoxFile:
    """The boxes of a detector or an annotation tool, and the best one of each photograph.

    A photograph is found by the end of its path: by the file's name, or the name without its
    ending, and by the folders that distinguish the photographs of the file.

    Args:
        path: a file of :func:`.read_boxes`, or a folder of them, each called as its photograph.
            ``PATH:LABEL`` takes only boxes of this label: its number, or its name; or
            ``PATH:id=7`` of this number of a tracker.

    Raises:
        MissingFileError: there is no such file or folder.
        InvalidInputError: the file cannot be read.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "boxes.json")
        >>> _ = file.write_text('[{"image_id": "a", "bbox": [10, 20, 30, 40], "score": 0.9}]')
        >>> BoxFile(file).box(Path("a.jpg"), lambda: PictureSize((480, 640)))
        (9.5, 19.5, 39.5, 59.5)
    """

    def __init__(self, path: PathName) -> None:
        self.path, self.label = split_name(path)
        # the photograph that was given boxes which name no folder: another of its name is refused
        self._owners: dict[str, str] = {}
        if not self.path.exists():
            raise MissingFileError(
                f"no such file or folder; {README} shows the formats", subject=path
            )
        if self.path.is_file():
            _ = self._images

    def box(self, photo: Path, picture: Callable[[], PictureSize]) -> Corners:
        """x0, y0, x1, y1 in px of the best box of a photograph.

        Args:
            photo: its path.
            picture: returns its size; called where the box depends on it.

        Raises:
            InvalidInputError: the photograph has no box, or several, none of which is the best; or
                boxes that are of a picture of another size, or of another photograph of its name.
        """
        found = self._find(photo, picture, owner=os.path.abspath(photo))
        if found is None:
            kind = f" of label {self.label!r}" if self.label else ""
            raise InvalidInputError(
                f"no box{kind} in {self.path}; detect it again, or leave the photograph out"
            )
        return found

    def of_frame(self, name: str, picture: PictureSize) -> Corners | None:
        """:meth:`box` of a frame of a video, called as its picture would be; None if it has
        none."""
        return self._find(Path(name), lambda: picture, owner="")

    def _find(
        self, photo: Path, picture: Callable[[], PictureSize], *, owner: str
    ) -> Corners | None:
        boxes = self._of(photo, owner)
        if self.label.startswith(ID_LABEL):
            boxes = [box for box in boxes if box.track == self.label.removeprefix(ID_LABEL)]
        elif self.label:
            boxes = [box for box in boxes if self.label in box.labels]
        return _in_pixels(_best(boxes, photo.name), picture) if boxes else None

    def _of(self, photo: Path, owner: str) -> list[ImageBox]:
        if self.path.is_dir():
            file, is_certain = self._label_file(photo)
            boxes = [] if file is None else read_boxes(file)
            key = str(file)
        else:
            key, is_certain = self._image(photo)
            boxes = self._images.get(key, [])
        if boxes and owner and not is_certain:
            self._check_owner(key, owner)
        return boxes

    def _check_owner(self, key: str, owner: str) -> None:
        """Refuse boxes that another photograph was given already; say once that folders differ."""
        if self.path.is_file() and _folders(key) and not self._owners:
            warnings.warn(CurviregWarning(f"boxes of {key} are used for {owner}"), stacklevel=2)
        first = self._owners.setdefault(key, owner)
        if first != owner:
            raise InvalidInputError(
                f"its box in {self.path} may be that of {first}, too; name their folders in the "
                "file, or put the files of boxes into folders called as theirs"
            )

    def _label_file(self, photo: Path) -> tuple[Path | None, bool]:
        """The file of a folder that is called as a photograph, in as many folders called as its
        own as there are; and whether there is such a folder."""
        around = Path(os.path.abspath(photo)).parts[1:-1][-MAX_FOLDERS:]
        for count in range(len(around), -1, -1):
            folder = self.path.joinpath(*around[len(around) - count :])
            files = [folder / f"{photo.stem}{suffix}" for suffix in SUFFIXES]
            files = [file for file in files if file.is_file()]
            if len(files) > 1:
                names = " and ".join(file.name for file in files)
                raise InvalidInputError(f"{folder}: {names} for one photograph; keep one of them")
            if files:
                return files[0], count > 0
        return None, True

    @cached_property
    def _images(self) -> Mapping[str, list[ImageBox]]:
        """The boxes of a file, by the photograph as the file names it."""
        images = defaultdict(list)
        for box in read_boxes(self.path):
            images[box.image].append(box)
        return images

    @cached_property
    def _names(self) -> Mapping[str, list[str]]:
        """The images of a file by the names that a photograph may be found by."""
        names = defaultdict(list)
        for image in self._images:
            path = PurePosixPath(_posix(image))
            for name in {path.name, path.stem, without_zeros(path.stem)}:
                names[name].append(image)
        return names

    @cached_property
    def _common_folders(self) -> int:
        """Number of folders that the images of a file have in common, from the first one on."""
        levels = zip(*map(_folders, self._images), strict=False)
        return sum(1 for _ in takewhile(lambda level: len(set(level)) == 1, levels))

    def _image(self, photo: Path) -> tuple[str, bool]:
        """The image of a file that is a photograph, and whether one of its folders says so."""
        around = _folders(os.path.abspath(photo))
        for name in (photo.name, photo.stem, without_zeros(photo.stem)):
            counts = {}
            for image in self._names.get(name, []):
                folders = _folders(image)
                in_common = 0 if ANY_FOLDER in folders else self._common_folders
                count = _matching(folders, around)
                if count >= len(folders) - in_common:  # all that distinguish images
                    counts[image] = count
            most = max(counts.values(), default=0)
            chosen = [image for image, count in counts.items() if count == most]
            if len(chosen) > 1:
                names = " and ".join(chosen[:3])
                raise InvalidInputError(
                    f"{self.path}: {names} may both be this photograph; name their folders"
                )
            if chosen:
                return chosen[0], most > 0
        return "", False


def _posix(name: str) -> str:
    return name.replace("\\", "/")


def _folders(name: str) -> list[str]:
    """The folders of a path, numbers without zeros in front."""
    parts = PurePosixPath(_posix(name)).parts[:-1]
    return [without_zeros(part) for part in parts if part not in ("/", ".", "..")]


def _matching(folders: Sequence[str], around: Sequence[str]) -> int:
    """How many folders at the end of two paths are the same."""
    pairs = zip(reversed(folders), reversed(around), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] in (pair[1], ANY_FOLDER), pairs))


def _best(boxes: Sequence[ImageBox], photograph: str) -> ImageBox:
    """The box of a photograph with the highest score, of several that show the same the first; two
    that differ in what they show are refused."""
    most = max(box.score for box in boxes)
    best = [box for box in boxes if box.score == most]
    tracks = dict.fromkeys(box.track for box in best)
    if len(tracks) > 1:
        raise InvalidInputError(
            f"boxes with a tracker's numbers ({listed(filter(None, tracks))}) and without scores; "
            f"choose one as PATH:{ID_LABEL}NUMBER, or write scores (save_conf of ultralytics)"
        )
    kinds = dict.fromkeys(max(box.labels, key=_is_word, default="") for box in best)
    if len(kinds) > 1:
        raise InvalidInputError(
            "boxes of several labels, none with a higher score; choose one as PATH:LABEL: "
            f"{listed(kinds)}"
        )
    if len({box.corners for box in best}) > 1:
        text = f"{len(best)} boxes of one label, none of a higher score: the first one is used"
        warnings.warn(CurviregWarning(f"{photograph}: {text}"), stacklevel=2)
    return best[0]


def _is_word(label: str) -> tuple[bool, str]:
    """Order of labels, of which the name says more than the number."""
    return not label.isdecimal(), label


def _in_pixels(box: ImageBox, picture: Callable[[], PictureSize]) -> Corners:
    """The corners in px of a photograph as it is shown."""
    if box.is_relative:
        return _of_fractions(box.corners, picture().shown)
    if box.size is None:
        return _from_centre(box.corners)
    return _fitted(box.corners, box.size, picture())


def _fitted(corners: Corners, size: Size, picture: PictureSize) -> Corners:
    """The corners in px of a photograph, of those in a picture of another size, or that was not
    turned as its EXIF data say."""
    if not _has_proportions(size, picture.shown):
        if not _has_proportions(size, picture.stored):
            boxed = f"{size[1]} x {size[0]} px"
            shown = f"{picture.shown[1]} x {picture.shown[0]}"
            raise InvalidInputError(
                f"its boxes are of a picture of {boxed}, but the photograph has {shown}, another "
                f"aspect ratio; give boxes of this photograph, uncropped"
            )
        corners = _turned(corners, size, picture.orientation)
        size = size[::-1]
    height, width = picture.shown
    return _from_centre(corners, width / size[1], height / size[0])


def _has_proportions(size: Size, other: Size) -> bool:
    """Whether two pictures differ in scale alone; sides are rounded."""
    h, w = size
    H, W = other
    return abs(w * H / h - W) <= 1 or abs(h * W / w - H) <= 1


def _turned(corners: Corners, size: Size, orientation: int) -> Corners:
    """Corners in the stored picture of (H, W) as they are where its EXIF orientation, above 4, is
    applied."""
    height, width = size
    x0, y0, x1, y1 = corners
    if orientation in (7, 8):
        x0, x1 = width - x1, width - x0
    if orientation in (6, 7):
        y0, y1 = height - y1, height - y0
    return y0, x0, y1, x1
