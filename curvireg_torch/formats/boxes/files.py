"""The boxes that a file lists, as they are written there."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ...errors import InvalidInputError
from ...utils.aliases import Document, Size
from ...utils.files import check_table_size, finite_numbers, read_json
from ..xml_files import read_xml

README = "docs/formats.md"
SUFFIXES = (".txt", ".json", ".xml")
"""Of files of boxes of one photograph, by which a folder of them is searched."""

PIXEL_CENTRE = 0.5
"""px from the centre of the first pixel to the picture's edge, where detectors count from."""

ANY_FOLDER = "*"
"""Of the path of an image: a folder of any name."""

ID_LABEL = "id="
"""Start of the label by which a box of a tracker is chosen."""

BEYOND = 0.05
"""Fraction of a picture by which a tracker's box may leave it."""

NEAR = 0.01
"""Fraction of a picture by which a box may be larger for a corner that may be none."""

Corners = tuple[float, float, float, float]


@dataclass(frozen=True)
class ImageBox:
    """One box of a file.

    Attributes:
        corners: x0, y0, x1, y1 from the picture's edge: in px, or in fractions of the picture.
        is_relative: whether they are fractions.
        image: the photograph as the file names it, perhaps with folders; "" of a file of one
            photograph, which does not name it.
        size: (H, W) of the picture that the box is of, where the file states it.
        score: of the detector; 1 without one.
        labels: number and name of what the box shows.
        track: the number that a tracker gave the object; "" without one.
    """

    corners: Corners
    is_relative: bool = False
    image: str = ""
    size: Size | None = None
    score: float = 1.0
    labels: frozenset[str] = frozenset()
    track: str = ""


def read_boxes(file: Path) -> list[ImageBox]:
    """The boxes of a file.

    Args:
        file: JSON of COCO, its annotations or its results; ``object_data.json`` of MegaPose; JSON
            of LabelMe; XML of Pascal VOC; or a text file of YOLO with boxes, oriented boxes or
            polygons, around which a box is laid.

    Raises:
        InvalidInputError: it is none of these, or has a value that cannot be meant.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "photo.txt")
        >>> _ = file.write_text("0 0.5 0.5 0.5 0.25 0.9")
        >>> read_boxes(file)[0].corners, read_boxes(file)[0].score
        ((0.25, 0.375, 0.75, 0.625), 0.9)
    """
    suffix = file.suffix.lower()
    try:
        if suffix not in (".txt", ".xml"):
            return list(_json(read_json(file, (dict, list), README)))
        check_table_size(file)
        if suffix == ".xml":
            return list(_xml(file.read_bytes()))
        return list(_yolo(file.read_text(encoding="utf-8-sig", errors="replace")))
    except InvalidInputError as error:
        raise error.with_subject(file) from error


def _refused(what: str) -> InvalidInputError:
    return InvalidInputError(f"{what}; {README} shows the formats")


# ---- YOLO: fractions of the picture -------------------------------------------------------------


def _yolo(text: str) -> Iterator[ImageBox]:
    """Lines of CLASS and numbers: a box, an oriented box or a polygon, behind which a score and a
    tracker's number may stand: behind all lines of a file, or none."""
    rows: list[tuple[int, list[str], tuple[float, ...]]] = []
    for count, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        try:
            numbers = tuple(map(float, words[1:]))
        except ValueError:
            numbers = ()
        if len(numbers) < 4 or not all(map(math.isfinite, numbers)):
            expected = "CLASS CX CY WIDTH HEIGHT [SCORE], or CLASS X0 Y0 X1 Y1 X2 Y2 ..., of YOLO"
            raise _refused(f"line {count}: expected {expected}")
        rows.append((count, words, numbers))
    ends = [numbers[-1] for *_, numbers in rows]
    are_tracks = {end > 1.0 and end == int(end) for end in ends if end != 1.0}
    has_tracks = are_tracks.pop() if len(are_tracks) == 1 else None
    for count, words, numbers in rows:
        # a tracker's number has no decimals
        box = _yolo_box(numbers, False if "." in words[-1] else has_tracks)
        if box is None:
            raise InvalidInputError(
                f"line {count}: ends with a corner on the border, or with a score and the "
                "tracker's number 1; begin it with another corner, or leave the number out"
            )
        yield replace(box, labels=frozenset((words[0],)))


def _yolo_box(numbers: Sequence[float], has_tracks: bool | None) -> ImageBox | None:
    """The box of the numbers of a line of a file whose other lines end with a tracker's number, or
    not; None if it depends on that, which they do not show."""
    count = len(numbers)
    x, y, width, height, *more = numbers
    corners = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
    is_whole = numbers[-1] >= 1.0 and numbers[-1] == int(numbers[-1])
    # outside, six numbers are the corners of a triangle, the last of which lies on the border
    is_inside = min(corners) > -BEYOND and max(corners) < 1.0 + BEYOND
    is_box = count < 6 or (count == 6 and is_whole and is_inside)
    # an even number that ends with 1 is a polygon down to the border, or ends with a score and a
    # track; the corners of an oriented box tell
    is_oriented = count in (8, 10) and all(
        abs(numbers[k] - numbers[k + 2] + numbers[k + 4] - numbers[k + 6]) < 1e-3 for k in (0, 1)
    )
    is_open = count > 6 and count % 2 == 0 and numbers[-1] == 1.0
    if is_open and not is_oriented and has_tracks is None:
        outer, inner = _around(numbers), _around(numbers[:-2])
        if max(abs(a - b) for a, b in zip(outer, inner, strict=True)) > NEAR:
            return None
    is_polygon = is_open and (count == 8 if is_oriented else not has_tracks)
    is_track = count > 4 if is_box else count > 6 and not is_polygon
    has_track = is_whole and is_track
    ending = more if is_box else list(numbers)
    track = str(int(ending.pop())) if has_track else ""
    has_score = len(ending) % 2
    score = ending.pop() if has_score else 1.0
    if score > 1.0:
        raise _refused(f"a score of {score:g}, above 1")
    return ImageBox(corners if is_box else _around(ending), True, score=score, track=track)


def _around(numbers: Sequence[float]) -> Corners:
    """The corners around points x, y, x, y, ..."""
    x = numbers[::2]
    y = numbers[1::2]
    return min(x), min(y), max(x), max(y)


# ---- JSON: COCO, MegaPose, LabelMe --------------------------------------------------------------


def _json(content: Any) -> Iterator[ImageBox]:
    first = content[0] if isinstance(content, list) and content else None
    if isinstance(first, dict) and "data" in first and "bbox" not in first:
        raise InvalidInputError("Label Studio's own JSON; export it as COCO, or as YOLO")
    fields = content if isinstance(content, dict) else {"annotations": content}
    if isinstance(fields.get("shapes"), list):
        return _labelme(fields)
    if isinstance(fields.get("annotations"), list):
        return _coco(fields)
    raise _refused("expected detections of COCO, or annotations of LabelMe")


def _labelme(content: Document) -> Iterator[ImageBox]:
    """Shapes of points in px from the picture's edge; a circle is its centre and a point on it."""
    size = _size(content.get("imageHeight"), content.get("imageWidth"))
    image = str(content.get("imagePath") or "")
    for index, shape in enumerate(content["shapes"]):
        points = shape.get("points") if isinstance(shape, dict) else None
        if isinstance(points, list) and len(points) < 2:
            continue  # a mark, around which there is no box
        numbers = _numbers_of_points(points)
        if len(numbers) < 4:
            raise _refused(f"shape {index}: expected points x, y")
        corners = _around(numbers)
        if shape.get("shape_type") == "circle":
            x, y, *edge = numbers[:4]
            radius = math.dist((x, y), edge)
            corners = (x - radius, y - radius, x + radius, y + radius)
        labels = _labels(shape.get("label", ""))
        yield ImageBox(corners, image=image, size=size, labels=labels)


def _labels(*names: object) -> frozenset[str]:
    return frozenset(map(str, names)) - {""}


def _numbers_of_points(points: Any) -> Sequence[float]:
    """x, y, x, y, ... of a list of points; none of anything else."""
    if not isinstance(points, list):
        return ()
    pairs = [finite_numbers(point, 2) for point in points]
    return () if None in pairs else [number for pair in pairs for number in pair or ()]


def _coco(content: Document) -> Iterator[ImageBox]:
    """Of COCO x, y, width, height from the picture's edge; of MegaPose ``bbox_modal``, corners from
    the centre of the first pixel."""
    images = _by_id(content.get("images"))
    categories = _by_id(content.get("categories"))
    for index, item in enumerate(content["annotations"]):
        fields = item if isinstance(item, dict) else {}
        is_corners = "bbox" not in fields
        numbers = finite_numbers(fields.get("bbox_modal" if is_corners else "bbox"), 4)
        if numbers is None:
            raise _refused(f"entry {index}: expected bbox of 4 numbers")
        x, y, c, d = numbers
        attributes = fields.get("attributes")
        turn = attributes.get("rotation") if isinstance(attributes, dict) else None
        corners = _turned((x, y, x + c, y + d), turn)
        if is_corners:
            corners = (x + PIXEL_CENTRE, y + PIXEL_CENTRE, c + PIXEL_CENTRE, d + PIXEL_CENTRE)
        score = finite_numbers([fields.get("score", 1.0)], 1) or (0.0,)
        category = str(fields.get("category_id", ""))
        name = categories.get(category, {}).get("name", "")
        labels = _labels(category, fields.get("label", ""), name)
        number = str(fields.get("image_id", ""))
        image = images.get(number, {})
        file_name = str(image.get("file_name", "") or number)
        if (scene := fields.get("scene_id")) is not None:  # of BOP: scene/rgb/image
            file_name = f"{scene}/{ANY_FOLDER}/{file_name}"
        size = _size(image.get("height"), image.get("width"))
        yield ImageBox(corners, image=file_name, size=size, score=score[0], labels=labels)


def _turned(corners: Sequence[float], degrees: Any) -> Corners:
    """The corners around a rectangle that is turned about its middle, as CVAT writes it."""
    x0, y0, x1, y1 = corners
    (turn,) = finite_numbers([degrees], 1) or (0.0,)
    if turn == 0.0:
        return x0, y0, x1, y1
    cosine, sine = abs(math.cos(math.radians(turn))), abs(math.sin(math.radians(turn)))
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    width = (x1 - x0) * cosine + (y1 - y0) * sine
    height = (x1 - x0) * sine + (y1 - y0) * cosine
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _by_id(entries: Any) -> dict[str, Document]:
    """The dicts of a list by their ``id``; of two that differ none is believed."""
    known: dict[str, Document] = {}
    for entry in entries if isinstance(entries, list) else []:
        number = str(entry.get("id")) if isinstance(entry, dict) else None
        if number is not None and known.setdefault(number, entry) != entry:
            raise InvalidInputError(
                f"two entries have the id {number}, as in files that were joined; number them anew"
            )
    return known


def _size(height: Any, width: Any) -> Size | None:
    """(H, W) where both are whole numbers > 0."""
    sides = finite_numbers([height, width], 2)
    if sides is None or min(sides) < 1 or any(side != int(side) for side in sides):
        return None
    return int(sides[0]), int(sides[1])


# ---- XML: Pascal VOC ----------------------------------------------------------------------------


def _xml(data: bytes) -> Iterator[ImageBox]:
    try:
        root = read_xml(data)
    except ValueError as error:
        raise InvalidInputError(f"damaged, or no XML that is read ({error})") from error
    if root.tag == "annotations":
        raise InvalidInputError("CVAT's own XML; export it as COCO 1.0, YOLO, or PASCAL VOC")
    if root.tag != "annotation":
        raise _refused("expected <annotation> of Pascal VOC")
    return _voc(root)


def _voc(root: ElementTree.Element) -> Iterator[ImageBox]:
    """Corners in px. The tools that write this today count from the picture's edge; VOC itself
    counts pixels from 1, which is half a pixel off at each side."""
    size = _size(_number(root, "size/height"), _number(root, "size/width"))
    image = root.findtext("filename", "").strip()
    folder = root.findtext("folder", "").strip()
    for index, item in enumerate(root.iter("object")):
        sides = [_number(item, f"bndbox/{name}") for name in ("xmin", "ymin", "xmax", "ymax")]
        corners = finite_numbers(sides, 4)
        if corners is None:
            raise _refused(f"object {index}: expected <bndbox> of xmin, ymin, xmax, ymax")
        attributes = {
            one.findtext("name", "").strip(): _number(one, "value")
            for one in item.iter("attribute")
        }
        box = _turned(corners, attributes.get("rotation"))
        name = f"{folder}/{image}" if folder and image else image
        labels = _labels(item.findtext("name", "").strip())
        yield ImageBox(box, image=name, size=size, labels=labels)


def _number(element: ElementTree.Element, path: str) -> float | None:
    try:
        return float(element.findtext(path, ""))
    except ValueError:
        return None
