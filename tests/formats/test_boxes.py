"""Boxes as detectors and annotation tools write them."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from curvireg_torch.errors import CurviregWarning, MissingFileError
from curvireg_torch.formats.boxes import BoxFile, PictureSize, pixel_box, read_boxes
from curvireg_torch.formats.boxes.finder import _has_proportions
from curvireg_torch.formats.pictures import oriented, picture_size
from curvireg_torch.jobs.options import with_advice
from curvireg_torch.registration.photograph import as_photographs
from tests._support.exif import exif, with_exif
from tests._support.real_data import real_case
from tests._support.refusals import refused
from tests._support.tables import text_table

SIZE = (48, 64)
BOX = (15.5, 11.5, 47.5, 35.5)  # of the pixels 16 to 47 and 12 to 35
OTHER = (0.5, 0.5, 8.5, 8.5)


@pytest.fixture
def photo(tmp_path):
    """A picture of 48 x 64 px."""
    path = tmp_path / "000012.png"
    Image.fromarray(np.zeros((*SIZE, 3), np.uint8)).save(path)
    return path


def box_of(boxes, photo, size=SIZE, orientation=1):
    """The box in a file, which may be open, of a photograph that need not exist."""
    boxes = boxes if isinstance(boxes, BoxFile) else BoxFile(boxes)
    return boxes.box(Path(photo), lambda: PictureSize(size, orientation))


def test_formats_of_four_numbers():
    assert pixel_box(BOX, "xyxy") == BOX
    assert pixel_box((15.5, 11.5, 32.0, 24.0), "xywh") == BOX
    assert pixel_box((0.25, 0.25, 0.75, 0.75), "fractions", SIZE) == BOX
    assert pixel_box((0.5, 0.5, 0.5, 0.5), "yolo", SIZE) == BOX
    with refused("expected fractions of the picture from 0 to 1; divide px by its size"):
        pixel_box((16.0, 12.0, 47.0, 35.0), "yolo", SIZE)
    with refused("not of a video"):
        pixel_box((0.5, 0.5, 0.5, 0.5), "yolo")


def test_the_size_is_that_of_the_turned_photograph(tmp_path, photo):
    assert picture_size(photo) == (SIZE, 1)
    with_exif(photo, exif(6))
    assert picture_size(photo) == (SIZE[::-1], 6)
    assert picture_size(photo).stored == SIZE
    Image.new("RGB", SIZE[::-1]).save(tmp_path / "a.tif", tiffinfo={274: 6})
    assert picture_size(tmp_path / "a.tif").shown == SIZE[::-1]


# ---- YOLO ---------------------------------------------------------------------------------------


def test_the_best_box_of_yolo(write, photo):
    lines = "0 0.1 0.1 0.1 0.1 0.3\n2 0.5 0.5 0.5 0.5 0.9\n\n"
    file = write("labels/000012.txt", lines)
    labels = file.parent
    assert box_of(labels, photo) == box_of(file, photo) == BOX
    x0, *_ = box_of(f"{labels}:0", photo)
    assert x0 == pytest.approx(0.05 * 64 - 0.5)
    with refused("no box of label '7' in"):
        box_of(f"{labels}:7", photo)
    with refused("no box in"):
        box_of(labels, "other.png")


YOLO = """
0 0.5 0.5 0.5 0.5                                | 1.0  |     | a box
\ufeff0 0.5 0.5 0.5 0.5                          | 1.0  |     | with a byte-order mark
0 0.5 0.5 0.5 0.5 0.25                           | 0.25 |     | with its score
0 0.5 0.5 0.5 0.5 7                              | 1.0  | "7" | of yolo track
0 0.5 0.5 0.5 0.5 0.25 7                         | 0.25 | "7" | with its score
0 0.25 0.5 0.5 0.25 0.75 0.75                    | 1.0  |     | a triangle
0 0.25 0.25 0.75 0.25 0.75 0.75 0.25 0.75        | 1.0  |     | an oriented box
0 0.5 0.25 0.75 0.5 0.5 0.75 0.25 0.5 0.25       | 0.25 |     | with its score
0 0.25 0.25 0.75 0.25 0.75 0.75 0.25 0.75 7      | 1.0  | "7" | with its number of a tracker
0 0.5 0.25 0.75 0.5 0.5 0.75 0.25 0.5 0.25 2     | 0.25 | "2" | with both
0 0.25 0.25 0.75 0.25 0.75 0.75 0.25 0.75 0.9 1  | 0.9  | "1" | with both, the first of them
0 0.25 0.5 0.5 0.25 0.75 0.75 3                  | 1.0  | "3" | a triangle with its number
0 0.25 0.5 0.5 0.25 0.75 0.5 0.6 0.75 0.4 0.75   | 1.0  |     | a polygon
0 0.25 0.5 0.5 0.25 0.75 0.5 0.6 0.75 0.4 0.75 2 | 1.0  | "2" | with its number of a tracker
"""


@pytest.mark.parametrize(
    "corners", ["0.1 0.2 0.5 0.9 0.9 1", "0.1 0.2 0.3 0.2 0.3 0.3 0.3 0.4 0.9 1"]
)
def test_a_polygon_that_ends_on_the_border_is_none_of_a_tracker(write, corners):
    box, _ = read_boxes(write("a.txt", f"0 {corners}\n0 0.1 0.1 0.1 0.2 0.2 0.2 0.2 0.1"))
    assert (box.corners, box.track) == ((0.1, 0.2, 0.9, 1.0), "")


def test_a_polygon_may_end_with_the_number_1_of_a_tracker(write):
    outline = "0 0.1 0.2 0.3 0.2 0.3 0.3 0.3 0.4 0.1 0.4"
    box, _ = read_boxes(write("a.txt", f"{outline} 0.9 1\n{outline} 0.8 2"))
    assert (box.corners, box.score, box.track) == ((0.1, 0.2, 0.3, 0.4), 0.9, "1")
    with refused("line 1: ends with a corner on the border, or with a score and the tracker's num"):
        read_boxes(write("a.txt", f"{outline} 0.9 1"))
    (box,) = read_boxes(write("a.txt", f"{outline} 0.9 1.000000"))
    assert box.corners == (0.1, 0.2, 0.9, 1.0), "a tracker's number has no decimals"
    (box,) = read_boxes(write("a.txt", f"{outline} 0.3 0.995 0.2 1"))
    assert box.corners == (0.1, 0.2, 0.3, 1.0), "either way"
    (box,) = read_boxes(write("a.txt", "0 0.25 0.75 0.5 0.5 0.75 0.75 0.5 1"))
    assert box.corners == (0.25, 0.5, 0.75, 1.0), "an oriented box"


@pytest.mark.parametrize(("line", "score", "track", "kind"), text_table(YOLO))
def test_lines_of_yolo_are_boxes_oriented_boxes_and_polygons(write, line, score, track, kind):
    (box,) = read_boxes(write("a.txt", line))
    assert box.corners == pytest.approx((0.25, 0.25, 0.75, 0.75))
    assert (box.score, box.track, box.labels) == (score, track, {"0"}), kind


def test_numbers_of_a_tracker_are_no_scores(write):
    lines = "0 0.5 0.5 0.5 0.5 1\n0 0.1 0.1 0.1 0.1 7\n"
    file = write("photo.txt", lines)
    with refused(r"a tracker's numbers \(1, 7\) .* as PATH:id=NUMB"):
        box_of(file, "photo.jpg")
    assert box_of(f"{file}:id=1", "photo.jpg") == BOX
    assert box_of(f"{file}:id=7", "photo.jpg") == pytest.approx((2.7, 1.9, 9.1, 6.7))
    with refused("no box of label 'id=3'"):
        box_of(f"{file}:id=3", "photo.jpg")
    scored = write("scored.txt", lines.replace(" 1\n", " 0.9 1\n"))
    assert box_of(scored, "scored.jpg") != BOX  # 1 where a score is not written


# ---- COCO, BOP, MegaPose ------------------------------------------------------------------------


def item(image, score, box=(16, 12, 32, 24), **more):
    return {"image_id": image, "category_id": 3, "bbox": list(box), "score": score, **more}


@pytest.mark.parametrize("image", ["000012", "000012.png", 12])
def test_results_of_coco(write, photo, image):
    file = write("boxes.json", [item(image, 0.2, (0, 0, 9, 9)), item(image, 0.8), item(7, 1.0)])
    assert box_of(file, photo) == BOX
    file.write_text(f"\ufeff{file.read_text()}", encoding="utf-8")
    assert box_of(f"{file}:3", photo) == BOX
    with refused("no box of label '4'"):
        box_of(f"{file}:4", photo)


def annotations(*images, height=48, width=64):
    """COCO's annotations: each image with its box, and the annotations' size of the pictures."""
    size = {"height": height, "width": width} if height else {}
    return {
        "images": [
            {"id": 90 + index, "file_name": name, **size} for index, (name, _) in enumerate(images)
        ],
        "categories": [{"id": 3, "name": "can"}, {"id": 4, "name": "box"}],
        "annotations": [
            {"image_id": 90 + index, "category_id": 3, "bbox": list(box)}
            for index, (_, box) in enumerate(images)
        ],
    }


PIXELS = (16, 12, 32, 24)  # BOX in COCO
CORNER = (1, 1, 8, 8)  # OTHER


def test_numbers_of_images_that_come_twice_are_refused(write):
    content = annotations(("a.png", PIXELS), ("b.png", CORNER))
    content["images"][1]["id"] = 90
    file = write("boxes.json", content)
    with refused(r"boxes.json: two entries have the id 90, as in"):
        box_of(file, "a.png")
    content["images"][1]["file_name"] = "a.png"
    assert box_of(
        write("boxes.json", {**content, "annotations": content["annotations"][:1]}), "a.png"
    )


def test_annotations_of_coco_name_images_and_categories(write):
    file = write("boxes.json", annotations(("shots\\000012.png", PIXELS)))
    assert box_of(f"{file}:can", "shots/000012.png") == BOX
    with refused("no box of label 'box'"):
        box_of(f"{file}:box", "shots/000012.png")


def test_rectangles_that_are_turned_lie_in_their_box(write):
    """As CVAT writes them: side lengths, and an angle about the middle."""
    turned = item("a.png", 1.0, (20, 8, 24, 32), attributes={"rotation": 90.0})
    assert box_of(write("boxes.json", [turned]), "a.png") == pytest.approx(BOX)
    turned["attributes"] = {"rotation": -30.0, "occluded": False}
    x0, y0, x1, y1 = box_of(write("boxes.json", [turned]), "a.png")
    sides = 12 * 3**0.5 + 16, 12 + 16 * 3**0.5
    assert (x1 - x0, y1 - y0, x0 + x1, y0 + y1) == pytest.approx((*sides, 63, 47))
    rotation = (
        "<attributes><attribute><name>rotation</name><value>90</value></attribute></attributes>"
    )
    voc = VOC.replace("<name>can</name>", f"<name>can</name>{rotation}")
    found = box_of(f"{write('photo.xml', voc)}:can", "shots/photo.jpg")
    assert found == pytest.approx((19.5, 7.5, 43.5, 39.5))


def test_photographs_of_one_name_are_told_apart_by_their_folders(write):
    content = annotations(("set/cam1/000001.jpg", CORNER), ("set/cam2/000001.jpg", PIXELS))
    boxes = BoxFile(write("boxes.json", content))
    assert box_of(boxes, "cam2/000001.jpg") == BOX
    assert box_of(boxes, "elsewhere/cam1/000001.jpg") == OTHER
    assert box_of(boxes, "/any/cam2/000001.png") == BOX, "another ending"
    with refused("no box in"):
        box_of(boxes, "cam3/000001.jpg")


def test_the_folder_of_a_file_of_one_folder_need_not_be_that_of_the_photographs(write):
    content = annotations(("export/000001.jpg", CORNER), ("export/000002.jpg", PIXELS))
    boxes = BoxFile(write("boxes.json", content))
    with pytest.warns(CurviregWarning, match=r"boxes of export/000002.jpg are used for .*shots/0"):
        assert box_of(boxes, "shots/000002.jpg") == BOX
    with refused(r"may be that of .*shots/000002.jpg, too"):
        box_of(boxes, "other/000002.jpg")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert box_of(boxes, "export/000002.jpg") == BOX


def test_two_images_that_may_be_the_photograph_are_refused(write):
    content = annotations(("cam1/a.jpg", CORNER), ("cam1/a.png", PIXELS))
    file = write("boxes.json", content)
    assert box_of(file, "cam1/a.png") == BOX
    with refused(r"cam1/a.jpg and cam1/a.png may both be this"):
        box_of(file, "cam1/a.tif")


PICTURES = """
[48, 64]  | 1 | [48, 64] | the same
[24, 32]  | 1 | [48, 64] | smaller
[96, 128] | 1 | [48, 64] | larger
[48, 64]  | 5 | [64, 48] | not turned
[48, 64]  | 6 | [64, 48] | not turned
[48, 64]  | 7 | [64, 48] | not turned
[48, 64]  | 8 | [64, 48] | not turned
[96, 128] | 6 | [64, 48] | larger and not turned
[64, 48]  | 6 | [64, 48] | of a tool that turns pictures, as ours
"""


@pytest.mark.parametrize(("annotated", "orientation", "shown", "kind"), text_table(PICTURES))
def test_boxes_of_pictures_of_another_size_or_not_turned(
    write, annotated, orientation, shown, kind
):
    """The box of some white pixels, in a picture of another size or orientation."""
    height, width = annotated
    is_stored = orientation > 4 and height < width
    stored = np.zeros((48, 64, 1), np.uint8)
    stored[6:18, 8:40] = 1
    seen = oriented(stored, orientation)
    pixels = stored if is_stored else seen
    factor = height / pixels.shape[0]
    rows, columns = pixels[..., 0].nonzero()
    corner = (factor * columns.min(), factor * rows.min())
    sides = (factor * (np.ptp(columns) + 1), factor * (np.ptp(rows) + 1))
    box = tuple(map(float, (*corner, *sides)))
    content = annotations(("a.jpg", box), height=height, width=width)
    file = write("boxes.json", content)
    rows, columns = seen[..., 0].nonzero()
    expected = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    found = box_of(file, "a.jpg", tuple(shown), orientation)
    assert found == pytest.approx(tuple(value - 0.5 for value in map(float, expected))), kind


def test_boxes_of_a_picture_of_other_proportions_are_refused(write):
    file = write("boxes.json", annotations(("a.jpg", PIXELS), height=48, width=80))
    for orientation in (1, 6):
        with refused(r"of 80 x 48 px, but .* 64 x 48, another"):
            box_of(file, "a.jpg", SIZE, orientation)
    with refused("a picture of 80 x 48 px"):
        box_of(file, "a.jpg", (80, 48))  # 90 degrees, which no EXIF data explain


def test_detections_of_bop_are_of_scenes(write, tmp_path):
    boxes = [item(12, 0.9, (0, 0, 9, 9), scene_id=2), item(12, 0.5, scene_id=1)]
    photo = tmp_path / "000001" / "rgb" / "000012.png"
    assert box_of(write("boxes.json", boxes), photo) == BOX
    without = write("without.json", [item(12, 0.9, (0, 0, 9, 9)), boxes[1]])
    assert box_of(without, photo) == BOX, "the scene goes before the number alone"
    only = write("only.json", boxes[1:])
    with refused("no box in"):
        box_of(only, tmp_path / "000003" / "rgb" / "000012.png")


def test_megapose_writes_corners_of_the_only_photograph(write, photo):
    file = write("object_data.json", [{"label": "can", "bbox_modal": list(BOX)}])
    assert box_of(file, photo) == BOX
    assert box_of(f"{file}:can", photo) == BOX
    boxes = BoxFile(file)
    assert box_of(boxes, photo) == box_of(boxes, photo) == BOX
    with refused("may be that of"):
        box_of(boxes, "second.png")
    for frame in ("turn-000001", "turn-000002"):
        assert boxes.of_frame(frame, PictureSize(SIZE)) == BOX


def test_boxes_of_two_labels_without_scores_need_a_choice(write):
    content = annotations(("a.jpg", CORNER), ("b.jpg", PIXELS))
    content["annotations"][1] |= {"image_id": 90, "category_id": 4}
    file = write("boxes.json", content)
    with refused("as PATH:LABEL: can, box"):
        box_of(file, "a.jpg")
    assert box_of(f"{file}:box", "a.jpg") == box_of(f"{file}:4", "a.jpg") == BOX
    content["annotations"][1]["category_id"] = 3  # two of a kind: the first
    with pytest.warns(CurviregWarning, match=r"a\.jpg: 2 boxes of one label, .*: the first one"):
        assert box_of(write("two.json", content), "a.jpg") == OTHER


# ---- LabelMe, VOC, and folders -------------------------------------------------------------------

LABELME = {
    "shapes": [
        {"label": "can", "points": [[48, 36], [16, 12]], "shape_type": "rectangle"},
        {"label": "box", "points": [[1, 1], [9, 1], [9, 9], [1, 9]], "shape_type": "polygon"},
        {"label": "eye", "points": [[5, 5], [5, 9]], "shape_type": "circle"},
        {"label": "tip", "points": [[5, 5]], "shape_type": "point"},
    ],
    "imagePath": "..\\shots\\photo.jpg",
    "imageHeight": 48,
    "imageWidth": 64,
}
VOC = """<annotation><folder>shots</folder><filename>photo.jpg</filename>
<size><width>64</width><height>48</height><depth>3</depth></size>
<object><name>can</name><bndbox><xmin>16</xmin><ymin>12</ymin><xmax>48</xmax><ymax>36</ymax></bndbox>
</object><object><name>box</name><part><name>lid</name></part>
<bndbox><xmin>1.0</xmin><ymin>1.0</ymin><xmax>9.0</xmax><ymax>9.0</ymax></bndbox></object></annotation>"""


@pytest.mark.parametrize(
    ("name", "content"), [("photo.json", LABELME), ("photo.xml", VOC)], ids=["labelme", "voc"]
)
def test_annotation_tools(write, name, content):
    file = write(f"labels/{name}", content)
    for path in (file, file.parent):
        assert box_of(f"{path}:can", "shots/photo.jpg") == BOX
        assert box_of(f"{path}:box", "shots/photo.jpg") == OTHER
        assert box_of(f"{path}:can", "shots/photo.jpg", (96, 128)) == (31.5, 23.5, 95.5, 71.5)
        with refused("choose one as PATH:LABEL: can, box"):
            box_of(path, "shots/photo.jpg")
    with refused("no box of label 'can'"):
        box_of(f"{file}:can", "shots/photo-2.jpg")


def test_a_circle_of_labelme_is_a_centre_and_a_point_on_it(write):
    file = write("photo.json", LABELME)
    assert box_of(f"{file}:eye", "shots/photo.jpg") == OTHER


def test_folders_of_labels_have_the_folders_of_the_photographs(write):
    write("labels/cam1/a.txt", "0 0.5 0.5 0.5 0.5")
    boxes = BoxFile(write("labels/a.txt", "0 0.25 0.25 0.25 0.25").parent)
    assert box_of(boxes, "shots/cam1/a.jpg") == BOX
    assert box_of(boxes, "shots/cam2/a.jpg") == pytest.approx((7.5, 5.5, 23.5, 17.5))
    with refused(r"may be that of .*cam2/a.jpg, too; name their"):
        box_of(boxes, "shots/cam3/a.jpg")
    write("labels/a.xml", VOC)
    with refused(r"a.txt and a.xml for one photograph; keep one"):
        box_of(boxes, "shots/cam2/a.jpg")


NO_BOXES = """
0 0.5 0.5 0.5                               | line 1: expected CLASS CX CY WIDTH HEIGHT
0 0.5 0.5 0.5 nan                           | line 1: expected CLASS CX CY WIDTH HEIGHT
0 0.5 0.5 0.5 0.5 1.5                       | a score of 1.5, above 1
0 0.5 0.5 0.5 0.5 1.5 3                     | a score of 1.5, above 1
0 .5 .1 .9 .5 .5 .9 1.5                     | a score of 1.5, above 1
{"a": 1}                                    | expected detections of COCO, or annotations of LabelMe
[{"image_id": 1}]                           | entry 0: expected bbox of 4 numbers
{"shapes": [{"points": [[1, 2], [3]]}]}     | shape 0: expected points x, y
<svg/>                                      | expected <annotation> of Pascal VOC
<annotation><object/></annotation>          | object 0: expected <bndbox> of xmin
<annotation>                                | damaged, or no XML that is read
<!DOCTYPE a [<!ENTITY b 'c'>]><annotation/> | an XML document type
"""


@pytest.mark.parametrize(("content", "words"), text_table(NO_BOXES))
def test_what_is_no_file_of_boxes_is_refused(write, content, words):
    suffix = {"<": "xml", "0": "txt"}.get(str(content)[0], "json")
    with refused(f"a.{suffix}: .*{words}"):
        BoxFile(write(f"a.{suffix}", content))


def test_a_missing_file_is_named(tmp_path):
    with refused("no such file or folder", MissingFileError):
        BoxFile(tmp_path / "lost.json:3")


# ---- shared cases --------------------------------------------------------------------------------

LAMP = (334.0, 146.0, 711.0, 573.5)


def test_files_of_annotation_tools():
    folder = real_case("n25-annotation-tools")
    for name in ("labelme.json", "voc.xml"):
        found = box_of(folder / name, "photo.jpg", (720, 960))
        assert found == pytest.approx(LAMP, abs=0.6)
    for name, words in (("cvat.xml", "CVAT's own XML; export"), ("label_studio.json", "export")):
        with refused(words):
            BoxFile(folder / name)


# ---- boxes by hand -------------------------------------------------------------------------------


def test_messages_name_the_format_that_is_suspected():
    pictures = torch.rand(1, 3, 48, 64)
    for box, words in (
        (
            [0.3, 0.2, 0.7, 0.8],
            "in px, not fractions of the photograph; multiply them by its size, or "
            "add --box-format fractions, or yolo, to --box or a list",
        ),
        (
            [40.0, 30.0, 20.0, 15.0],
            "corners, not width and height, or add --box-format xywh to --box or a list",
        ),
        ([5.0, 5.0, 10.0, 40.0], "the part of the photograph in the box has 5.0 px"),
    ):
        (found,) = as_photographs(pictures, [box], None)
        assert words in with_advice(found)
        assert "--" not in str(found)


@pytest.mark.parametrize(("size", "axis"), [((1000, 4000), 0), ((4000, 1000), 1)])
@pytest.mark.parametrize(("more", "expected"), [(0, True), (1, True), (3, False)])
def test_sides_of_a_smaller_picture_are_rounded(size, axis, more, expected):
    """One pixel of the shorter side is four of the longer one."""
    smaller = [side // 10 for side in size]
    smaller[axis] += more
    assert _has_proportions(size, tuple(smaller)) == expected
