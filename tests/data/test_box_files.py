"""Boxes as detectors write them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from curvireg_torch.data.box_files import BoxFile, pixel_box
from curvireg_torch.data.images import photo_size
from curvireg_torch.errors import InvalidInputError, MissingFileError
from curvireg_torch.jobs.options import with_advice
from curvireg_torch.registration.inputs import image_items
from tests._support.exif import exif, with_exif

SIZE = (48, 64)
BOX = (15.5, 11.5, 47.5, 35.5)  # of the pixels 16 to 47 and 12 to 35


@pytest.fixture
def photo(tmp_path):
    """A picture of 48 x 64 px."""
    path = tmp_path / "000012.png"
    Image.fromarray(np.zeros((*SIZE, 3), np.uint8)).save(path)
    return path


def written(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_formats_of_four_numbers():
    assert pixel_box(BOX, "xyxy") == BOX
    assert pixel_box((15.5, 11.5, 32.0, 24.0), "xywh") == BOX
    assert pixel_box((0.25, 0.25, 0.75, 0.75), "fractions", SIZE) == BOX
    assert pixel_box((0.5, 0.5, 0.5, 0.5), "yolo", SIZE) == BOX
    with pytest.raises(
        InvalidInputError,
        match="expected fractions of the picture from 0 to 1; of px, give another format",
    ):
        pixel_box((16.0, 12.0, 47.0, 35.0), "yolo", SIZE)
    with pytest.raises(InvalidInputError, match="not of a video"):
        pixel_box((0.5, 0.5, 0.5, 0.5), "yolo")


def test_the_size_is_that_of_the_turned_photograph(tmp_path, photo):
    assert photo_size(photo) == SIZE
    with_exif(photo, exif(6))
    assert photo_size(photo) == SIZE[::-1]
    Image.new("RGB", SIZE[::-1]).save(tmp_path / "a.tif", tiffinfo={274: 6})
    assert photo_size(tmp_path / "a.tif") == SIZE[::-1]


def test_the_best_box_of_yolo(tmp_path, photo):
    labels = tmp_path / "labels"
    labels.mkdir()
    written(labels / "000012.txt", "0 0.1 0.1 0.1 0.1 0.3\n2 0.5 0.5 0.5 0.5 0.9\n\n")
    assert BoxFile(labels).box(photo) == BOX
    assert BoxFile(labels / "000012.txt").box(photo) == BOX
    x0, *_ = BoxFile(f"{labels}:0").box(photo)
    assert x0 == pytest.approx(0.05 * 64 - 0.5)
    with pytest.raises(InvalidInputError, match="no box of label '7' in"):
        BoxFile(f"{labels}:7").box(photo)
    with pytest.raises(InvalidInputError, match="no box in"):
        BoxFile(labels).box(Path("other.png"))
    written(labels / "000012.txt", "0 0.5 0.5 0.5\n")
    with pytest.raises(InvalidInputError, match="line 1: expected CLASS CX CY WIDTH HEIGHT"):
        BoxFile(labels).box(photo)


def item(image, score, box=(16, 12, 32, 24), **more):
    return {"image_id": image, "category_id": 3, "bbox": list(box), "score": score, **more}


@pytest.mark.parametrize("image", ["000012", "000012.png", 12])
def test_results_of_coco(tmp_path, photo, image):
    file = written(
        tmp_path / "boxes.json", [item(image, 0.2, (0, 0, 9, 9)), item(image, 0.8), item(7, 1.0)]
    )
    assert BoxFile(file).box(photo) == BOX
    assert BoxFile(f"{file}:3").box(photo) == BOX
    with pytest.raises(InvalidInputError, match="no box of label '4'"):
        BoxFile(f"{file}:4").box(photo)


def test_annotations_of_coco_name_images_and_categories(tmp_path, photo):
    content = {
        "images": [{"id": 99, "file_name": "shots\\000012.png"}],
        "categories": [{"id": 3, "name": "can"}],
        "annotations": [{"image_id": 99, "category_id": 3, "bbox": [16, 12, 32, 24]}],
    }
    file = written(tmp_path / "boxes.json", content)
    assert BoxFile(f"{file}:can").box(photo) == BOX


def test_detections_of_bop_are_of_scenes(tmp_path):
    boxes = [item(12, 0.9, (0, 0, 9, 9), scene_id=2), item(12, 0.5, scene_id=1)]
    file = written(tmp_path / "boxes.json", boxes)
    assert BoxFile(file).box(tmp_path / "000001" / "rgb" / "000012.png") == BOX


def test_megapose_writes_corners_of_the_only_photograph(tmp_path, photo):
    file = written(tmp_path / "object_data.json", [{"label": "can", "bbox_modal": list(BOX)}])
    assert BoxFile(file).box(photo) == BOX
    assert BoxFile(f"{file}:can").box(photo) == BOX


def test_what_is_no_file_of_boxes_is_refused(tmp_path):
    for content, words in (
        ({"a": 1}, "expected detections of COCO"),
        ([{"image_id": 1}], "entry 0: expected bbox"),
    ):
        with pytest.raises(InvalidInputError, match=words):
            BoxFile(written(tmp_path / "a.json", content))
    with pytest.raises(MissingFileError, match="no such file or folder"):
        BoxFile(tmp_path / "lost.json:3")


def test_messages_name_the_format_that_is_suspected():
    pictures = torch.rand(1, 3, 48, 64)
    for box, words in (
        (
            [0.3, 0.2, 0.7, 0.8],
            "in px, not fractions of the photograph; multiply them by its size, or give "
            "--box-format fractions, or yolo",
        ),
        ([40.0, 30.0, 20.0, 15.0], "corners, not width and height, or --box-format xywh"),
        ([5.0, 5.0, 10.0, 40.0], "the part of the photograph in the box has 5.0 px"),
    ):
        (found,) = image_items(pictures, [box], None)
        assert words in with_advice(found)
        assert "--" not in str(found)
