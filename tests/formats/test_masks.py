"""Masks as programs write them: white, labels, palettes, transparency."""

import os

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from curvireg_torch.data.images import read_photo
from curvireg_torch.errors import MissingFileError
from curvireg_torch.formats.masks import mask_as_shown, mask_file, read_mask
from curvireg_torch.formats.pictures import picture_size
from curvireg_torch.registration.photograph import as_photograph
from tests._support.exif import exif, with_exif
from tests._support.refusals import refused

OBJECT = np.zeros((20, 30), bool)
OBJECT[4:14, 6:24] = True


def check(mask, expected=OBJECT):
    """A mask shows this, without borders between."""
    found = read_mask(mask)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, expected)


def written(path, values):
    Image.fromarray(values).save(path)
    return path


@pytest.mark.parametrize("white", [255, 200, 2, 1, 127])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_one_value_beside_zero_is_the_object(tmp_path, white, dtype):
    value = white if white < 200 or dtype == np.uint8 else 257 * white
    file = written(tmp_path / "mask.png", (value * OBJECT).astype(dtype))
    found = read_mask(file)
    assert np.array_equal(found >= 0.5, OBJECT)
    assert found.dtype == np.float32
    item = as_photograph(torch.rand(3, 20, 30), None, mask=file)
    assert item.box.tolist() == [5.5, 3.5, 23.5, 13.5]


def test_labels_are_chosen_by_their_number(tmp_path):
    labels = np.zeros((20, 30), np.uint8)
    labels[OBJECT] = 2
    labels[:3] = 5
    file = written(tmp_path / "labels.png", labels)
    check(f"{file}:2")
    check(f"{file}:5", labels == 5)
    with refused("no white pixel, but labels 2, 5; choose one as FILE:LABEL"):
        read_mask(file)
    with refused("no pixel has the label 3; it has 0, 2, 5"):
        read_mask(f"{file}:3")
    bright = written(tmp_path / "bright.png", np.where(labels == 2, 200, labels).astype(np.uint8))
    check(f"{bright}:200")
    deep = written(tmp_path / "deep.png", (300 * labels.astype(np.uint16)))
    check(f"{deep}:600")
    with refused(r"lost\.png:2: no such file", MissingFileError):
        read_mask(tmp_path / "lost.png:2")
    with refused("a folder; give the file of one mask"):
        read_mask(tmp_path)
    assert mask_file("a:b") == mask_file(mask_file("a:b")[0])


def test_palettes_are_labels_unless_they_are_black_and_white(tmp_path):
    labels = OBJECT.astype(np.uint8) * 2
    picture = Image.fromarray(labels, "P")
    picture.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    picture.save(tmp_path / "voc.png")
    check(tmp_path / "voc.png")
    check(f"{tmp_path / 'voc.png'}:2")
    picture = Image.fromarray(1 - OBJECT.astype(np.uint8), "P")
    picture.putpalette([255, 255, 255, 0, 0, 0])
    picture.save(tmp_path / "inverse.png")
    check(tmp_path / "inverse.png")


def test_void_of_label_images_is_neither_white_nor_the_object(tmp_path):
    labels = np.zeros((20, 30), np.uint8)
    labels[3:15, 5:25] = 255
    labels[OBJECT] = 1
    picture = Image.fromarray(labels, "P")
    picture.putpalette([0, 0, 0, 255, 0, 0, *[128] * 753, 224, 224, 192])
    picture.save(tmp_path / "void.png")
    check(tmp_path / "void.png")
    check(f"{tmp_path / 'void.png'}:1")
    with refused("white pixels, which may be void, and labels 1; choose one as FILE:LABEL"):
        read_mask(written(tmp_path / "grey.png", labels))
    check(f"{tmp_path / 'grey.png'}:1")
    soft = 255 * (labels > 0).astype(np.uint8)
    soft[3, 5:9] = 64
    mask = read_mask(written(tmp_path / "soft.png", soft))
    assert mask[3, 5] == pytest.approx(64 / 255), "few dark pixels are an edge"
    labels[0] = 200
    picture.frombytes(labels.tobytes())
    picture.save(tmp_path / "two.png")
    with refused("no white pixel, but labels 1, 200"):
        read_mask(tmp_path / "two.png")


def test_a_label_of_a_pure_colour_is_chosen_by_its_index(tmp_path):
    picture = Image.fromarray(OBJECT.astype(np.uint8), "P")
    picture.putpalette([0, 0, 0, 255, 0, 0])
    picture.save(tmp_path / "red.png")
    check(tmp_path / "red.png")
    check(f"{tmp_path / 'red.png'}:1")


def test_transparency_that_varies_is_the_mask(tmp_path):
    picture = np.random.default_rng(0).integers(0, 255, (20, 30, 4), dtype=np.uint8)
    picture[..., 3] = 255 * OBJECT
    file = written(tmp_path / "cut.png", picture)
    check(file)
    few = Image.fromarray(picture).quantize(64, method=Image.Quantize.FASTOCTREE)
    few.save(tmp_path / "palette.png")
    check(tmp_path / "palette.png")
    labels = Image.fromarray(OBJECT.astype(np.uint8), "P")
    labels.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
    labels.putpixel((0, 0), 2)
    labels.save(tmp_path / "labels.png", transparency=0)
    with refused("no white pixel, but labels 1, 2"):
        read_mask(tmp_path / "labels.png")
    picture[0, 0, 3] = 60  # no label
    found = read_mask(written(tmp_path / "soft.png", picture))
    assert np.allclose(found, picture[..., 3] / 255)
    picture[...] = 255 * OBJECT[..., None]
    picture[..., 3] = 255
    check(written(tmp_path / "opaque.png", picture))


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_masks_are_turned_as_their_photographs(tmp_path, suffix):
    file = tmp_path / f"mask{suffix}"
    if suffix == ".png":
        cv2.imwrite(str(file), 255 * OBJECT.astype(np.uint8))
        with_exif(file, exif(6))
    else:
        Image.fromarray(255 * OBJECT.astype(np.uint8)).save(file, tiffinfo={274: 6})
    assert np.array_equal(read_mask(file) > 0, np.rot90(OBJECT, -1))


def test_arrays_of_labels_are_read_as_files_are():
    item = as_photograph(torch.rand(3, 20, 30), None, mask=2 * OBJECT.astype(np.uint8))
    assert torch.equal(item.mask, torch.from_numpy(OBJECT).float())
    with refused(r"labels 2, 5; .* mask == LABEL"):
        as_photograph(
            torch.rand(3, 20, 30), None, mask=torch.from_numpy(2 + 3 * OBJECT.astype(np.uint8))
        )


def test_soft_borders_of_a_white_object_are_kept(tmp_path):
    soft = cv2.blur(255 * OBJECT.astype(np.uint8), (3, 3))
    file = written(tmp_path / "soft.png", soft)
    assert np.allclose(read_mask(file), soft / 255.0)
    assert len(np.unique(read_mask(file))) > 3


@pytest.mark.skipif(os.name == "nt", reason="no colons in names of files")
def test_a_file_whose_name_ends_like_a_label_is_read(tmp_path):
    file = tmp_path / "labels.png:2"
    assert mask_file(file) == (tmp_path / "labels.png", 2)
    file.write_bytes(b"")
    assert mask_file(file) == (file, None)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("form", ["path", "array", "tensor"])
def test_masks_of_the_pixels_in_the_file_are_turned_with_the_photograph(
    tmp_path, orientation, form
):
    """Where the shape shows it: of a picture that is turned by 90 degrees."""
    file = written(tmp_path / "photo.png", np.where(OBJECT, 255, 40).astype(np.uint8))
    with_exif(file, exif(orientation))
    photo = read_photo(file)
    as_shown = photo.image[0].numpy() == 255
    given = OBJECT if orientation > 4 else as_shown
    mask = written(tmp_path / "mask.png", 255 * given.astype(np.uint8))
    forms = {"path": mask, "array": given, "tensor": torch.from_numpy(np.array(given))}
    for shown in (forms[form], as_shown):
        item = as_photograph(photo.image, None, mask=mask_as_shown(shown, picture_size(file)))
        assert np.array_equal(item.mask.numpy() >= 0.5, as_shown)
