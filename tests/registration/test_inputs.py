"""Photographs, boxes and cameras as callers have them: decoded once, and questioned where they look
like mistakes."""

import weakref
from dataclasses import replace

import numpy as np
import torch
from PIL import Image

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import camera_matrix
from curvireg_torch.pipeline import FitSettings
from curvireg_torch.registration import Registrar, block
from curvireg_torch.registration import photograph as photograph_module
from curvireg_torch.registration.photograph import (
    Photograph,
    as_photo,
    as_photographs,
    camera_warnings,
)
from tests._support import (
    CAMERA,
    SIZE,
    answer_of,
    first_scenes,
    learned_answer,
    learned_registrar,
    scene,
    truck_registrar,
    write_photo,
)

VGA = (480, 640)


def test_cameras_and_boxes_that_look_like_mistakes_are_questioned_or_refused():
    for camera, parts in (
        ((325, 325, 572, 573), ["(572, 573) lies outside", "640 x 480", "seem to be swapped"]),
        # inside the picture, but no swapped camera
        ((572, 700, 573, 650), ["near the centre"]),
        ((1450, 1450, 960, 540), ["belong to a picture of about 1921 x 1081 px; scale it"]),
        ((600, 600, 0, 0), ["(0, 0) lies outside", "near the centre"]),
        ((35, 35, 319.5, 239.5), ["35 px gives", "168 degrees; it is in px"]),
        ((12801, 12801, 319.5, 239.5), ["2.86 degrees; scale it"]),
        ((572, 573, 325, 242), []),
        ((12799, 12799, 319.5, 239.5), []),
        ((600, 600, 0, 200), []),
        # half the size, 2/3 and 1.6 times
        ((286, 286, 162.5, 120.5), ["seems to be of a picture of 326 x 242; scale it"]),
        ((381, 381, 216.5, 161.25), ["a picture of 434 x 324"]),
        ((915, 915, 520, 387.5), ["a picture of 1041 x 776"]),
        # turned by 90 degrees, and not quite
        ((572, 573, 260, 300), ["a picture of 480 x 640; turn one of the two by 90 degrees"]),
        ((572, 573, 239.5, 353), []),
        # cropped, or within 0.1 of the middle
        ((572, 573, 162.5, 242), []),
        ((572, 573, 380, 288), []),
    ):
        text = "; ".join(camera_warnings(camera_matrix(*camera), VGA))
        assert bool(text) == bool(parts)
        for part in parts:
            assert part in text
    nearly_square = camera_matrix(572, 573, 240, 260)
    assert not camera_warnings(nearly_square, (480, 520))
    for box, refused, warned in (
        ([10, 10, 21.9, 200], True, True),
        ([10, 10, 22, 200], False, True),
        ([10, 10, 33.9, 200], False, True),
        ([10, 10, 34, 34], False, False),
        ([-50, 10, 11, 200], True, True),  # 11.5 px are inside the picture
        ([10, 400, 200, 491.5], False, False),
    ):
        picture = torch.rand(1, *VGA)
        assert bool(Photograph(picture, torch.tensor(box).float(), None).warnings) == warned
        item = as_photographs([picture], [box], None)[0]
        assert isinstance(item, InvalidInputError) == refused
        assert ("at least 12 are needed" in str(item)) == refused


def test_arrays_of_any_strides_and_byte_order_are_photographs():
    pixels = np.asarray(Image.new("RGB", (60, 40), "red"))  # is read-only
    single = pixels.astype("f4") / 255
    expected = as_photo(pixels).image
    assert torch.equal(as_photo(pixels[::-1]).image.flip(1), expected)
    assert torch.equal(as_photo(single.astype(">f4")).image, as_photo(single).image)
    assert pixels.flags.writeable is False
    sparse = expected.float().to_sparse()
    small = expected.to(torch.float8_e5m2)
    bad = pixels.astype(object), single.astype(np.longdouble), sparse, small
    for item in as_photographs(bad, None, None):
        assert isinstance(item, InvalidInputError)
        assert "photograph: expected" in str(item)


def test_result_with_a_questionable_camera_is_never_reliable():
    image, box, T = scene(0)
    far = camera_matrix(260.0, 260.0, 300.0, 400.0)
    known = learned_registrar()
    pipeline = replace(known.pipeline, fit=FitSettings(reliable=0.0))
    registrar = Registrar(known.bank, pipeline=pipeline)
    bad = answer_of(registrar, image, box, far)
    assert learned_answer().reliable
    assert learned_answer().warnings == ()
    assert not bad.reliable
    assert bad.covariance is None
    assert bad.to_dict()["warnings"] == camera_warnings(far, SIZE)
    # half the picture: its centre lies outside
    refined = registrar.refine([image[:, :, :100]], CAMERA, [T])[0]
    assert not refined.ok or refined.warnings


def test_photographs_are_decoded_once_and_not_kept(tmp_path, monkeypatch):
    read_photo = photograph_module.read_photo
    alive = weakref.WeakSet()
    counts = []
    decoded = []

    def counted(path, **options):
        photo = read_photo(path, **options)
        alive.add(photo.image)
        decoded.append(path)
        counts.append(len(alive))
        return photo

    monkeypatch.setattr(photograph_module, "read_photo", counted)
    monkeypatch.setitem(block.BLOCK, "cpu", 2)
    images, boxes, _ = first_scenes(6)
    paths = [tmp_path / f"{seed}.png" for seed in range(6)]
    for path, image in zip(paths, images, strict=True):
        write_photo(path, image)
    results = truck_registrar(contours=False)(paths, boxes, CAMERA)
    assert all(result.ok for result in results)
    assert sorted(decoded) == paths, "each once"
    assert max(counts) <= 2 * 2, "those of a block, and of the one before"
    assert len(alive) <= 2
