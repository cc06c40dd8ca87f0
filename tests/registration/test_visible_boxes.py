"""Boxes of what a photograph shows of an object that something else hides a part of."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.geometry.framing import (
    HIDDEN_EXTENSIONS,
    VISIBLE_MARGIN,
    around_visible,
    hidden_boxes,
    photograph_box,
)
from curvireg_torch.registration.photograph import as_photograph
from curvireg_torch.registration.rig import RigPhotograph
from curvireg_torch.registration.stages import _in_box_of_pose, describe, rank
from tests._support import (
    CAMERA,
    SIZE,
    answer_of,
    degrees_off,
    double,
    eye,
    learned_registrar,
    scene,
    slow_after,
)


def visible_registrar(**changes):
    registrar = learned_registrar()
    pipeline = replace(registrar.pipeline.with_boxes("visible"), **changes)
    return cr.Registrar(registrar.bank, pipeline=pipeline)


def half_hidden(seed):
    """A photograph whose object is hidden from 45 % of its width on, the box of what is visible,
    and the true pose."""
    image, box, T = scene(seed)
    end = int(box[0] + 0.45 * (box[2] - box[0]))
    covered = image.clone()
    covered[:, :, end:] = image[:, :, end:].mean()
    return covered, torch.tensor([box[0], box[1], end - 0.5, box[3]]), T


def test_hidden_boxes_go_on_beyond_one_side_each():
    box = double([10.0, 20.0, 50.0, 40.0])
    found = torch.stack(hidden_boxes(box)) - box
    assert len(found) == 4 * len(HIDDEN_EXTENSIONS)
    for few, extension in zip(found.split(4), HIDDEN_EXTENSIONS, strict=True):
        expected = extension * double([-40.0, -20.0, 40.0, 20.0]).diag()
        torch.testing.assert_close(few, expected)


def test_what_is_shown_is_the_box_with_a_margin_inside_the_photograph():
    box = double([10.0, 1.0, 50.0, 21.0])
    margin = VISIBLE_MARGIN * 40.0
    expected = [10.0 - margin, -0.5, 50.0 + margin, 21.0 + margin]
    assert around_visible(box, (100, 200)).tolist() == pytest.approx(expected)


def test_what_lies_beside_a_visible_box_does_not_count():
    """Neither for the similarity nor for the contours; beside a whole object's box it does."""
    image, box, _ = scene(0)
    middle = 0.5 * (box[:2] + box[2:])
    beside = torch.stack([box[2] + 0.07 * (box[2:] - box[:2]).max(), middle[1]])
    points = torch.stack([middle, beside]).double()
    valid = torch.ones(1, 2, dtype=torch.bool)
    item = as_photograph(image, box, CAMERA)
    result = SimpleNamespace(corrected_box=None, ranking=None)
    for registrar, count in ((visible_registrar(), 1), (learned_registrar(), 2)):
        block = rank(registrar, [item], describe(registrar, [item]))
        of_rig = RigPhotograph.of(registrar, item, result, 0, eye(4))
        to_crop = block.crops.transforms[0]
        uv = (points @ to_crop[:2, :2].T + to_crop[:2, 2])[None]
        for crops in (block.crops, of_rig.crops):
            assert int(crops.edges(1).counts(uv, valid, torch.tensor([0])).sum()) == count
        shown = registrar.shown_around(item.box, item.size)
        is_whole = shown.equal(photograph_box(SIZE))
        assert is_whole == (block.frames[0] is None) == (count == 2)


@pytest.mark.parametrize("seed", slow_after(1, [0, 8]))
def test_a_hidden_half_needs_a_box_that_is_said_to_be_visible(seed):
    image, box, T = half_hidden(seed)
    result = answer_of(visible_registrar(), image, box)
    assert degrees_off(result, T) < 10.0
    item = as_photograph(image, box, CAMERA)
    assert _in_box_of_pose(visible_registrar(box_jitter=0.1), [item], result, 0, 0.85) is None
    whole = cr.Registrar(learned_registrar().bank)
    assert _in_box_of_pose(whole, [item], result, 0, 0.85) is not None
    as_whole = answer_of(learned_registrar(), image, box)
    assert degrees_off(as_whole, T) > 15.0
    assert not as_whole.reliable


def test_similar_meshes_and_views_of_the_bank_are_compared_as_before():
    image, box, _ = half_hidden(0)
    known = learned_registrar()
    for changes, mesh_is in (({}, "similar"), ({"contours": False}, None)):
        whole, visible = (
            cr.Registrar(
                known.bank,
                pipeline=replace(known.pipeline.with_boxes(box_is), **changes),
                mesh_is=mesh_is,
            )
            for box_is in ("whole", "visible")
        )
        expected = answer_of(whole, image, box).rotation
        assert answer_of(visible, image, box).rotation.equal(expected)
