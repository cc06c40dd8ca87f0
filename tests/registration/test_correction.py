"""Boxes that are only roughly right."""

from dataclasses import replace

import pytest
import torch

import curvireg_torch as cr
from curvireg_torch.geometry import box_iou, rotation_error
from curvireg_torch.registration import correction
from curvireg_torch.registration.correction import projected_box
from curvireg_torch.registration.document import result_document, used_box
from tests._support.scenes import CAMERA, scene, truck_bank, unrefined

EDGES = torch.tensor([-0.18, 0.15, 0.02, 0.2])
"""Errors of a box's edges as fractions of its sides."""


def roughly(box):
    return box + EDGES * (box[2:] - box[:2]).repeat(2)


@pytest.fixture(scope="module")
def registrar():
    return cr.Registrar(truck_bank())


def as_it_is(registrar, image, box, camera=CAMERA):
    """The answer with the box as it is given."""
    return cr.Registrar(registrar.bank, pipeline=replace(registrar.pipeline, box_jitter=0.0))(
        [image], box[None], camera
    )[0]


def test_the_box_around_the_pose_takes_the_place_of_one_that_is_wrong(registrar):
    image, box, truth = scene(0)
    wrong = roughly(box)
    result = registrar([image], wrong[None], CAMERA)[0]
    (before,) = registrar.register_items([correction.ImageItem(image, wrong, CAMERA)])
    assert rotation_error(before.rotation, truth[:3, :3]) > 5
    assert rotation_error(result.rotation, truth[:3, :3]) < 2
    assert result.score > before.score
    assert torch.equal(result.corrected_box, projected_box(registrar, before).float().double())
    right = box[None].double()
    assert box_iou(result.corrected_box[None], right) > box_iou(wrong[None].double(), right) + 0.1
    document = {**result_document(result, registrar, {}), "inputs": {"box": [1.0, 2.0, 3.0, 4.0]}}
    assert used_box(document) == document["corrected_box"] == result.corrected_box.tolist()
    assert used_box({**document, "corrected_box": None}) == [1.0, 2.0, 3.0, 4.0]


def test_one_answer_of_a_batch_may_be_corrected(registrar):
    scenes = [scene(seed) for seed in (0, 1, 3)]
    boxes = torch.stack([roughly(scenes[0][1]), scenes[1][1], roughly(scenes[2][1])])
    boxes[2] = torch.tensor([9e3, 9e3, 1e4, 1e4])  # outside: fails as ever
    results = registrar([image for image, *_ in scenes], boxes, CAMERA)
    assert [result.ok for result in results] == [True, True, False]
    alone = registrar([scenes[0][0]], boxes[:1], CAMERA)[0]
    assert torch.equal(results[0].corrected_box, alone.corrected_box)
    assert torch.allclose(results[0].rotation, alone.rotation, atol=1e-9)
    assert results[1].corrected_box is None


def test_boxes_that_fit_stay(registrar, monkeypatch):
    """They cost nothing: nothing is registered again."""
    image, box, _ = scene(0)
    (expected,) = registrar.register_items([correction.ImageItem(image, box, CAMERA)])
    asked = []
    monkeypatch.setattr(registrar, "register", lambda items, _: asked.append(len(items)) or [expected] * len(items))
    assert registrar([image], box[None], CAMERA)[0] is expected
    assert asked == [1]


@pytest.mark.parametrize("better", [True, False])
def test_the_view_that_is_more_like_the_photograph_stays(registrar, monkeypatch, better):
    image, box, _ = scene(0)
    (first,) = registrar.register_items([correction.ImageItem(image, box, CAMERA)])
    other = replace(first, hypotheses=(replace(first.hypotheses[0], score=first.score + (0.01 if better else -0.01)),))
    answers = iter([[first], [other]])
    monkeypatch.setattr(registrar, "register_items", lambda *_, **__: next(answers))
    result = registrar([image], roughly(box)[None], CAMERA)[0]
    assert (result is first) != better
    assert (result.corrected_box is None) != better


def test_boxes_are_taken_as_they_are_where_that_is_asked_for(registrar):
    image, box, _ = scene(0)
    wrong = roughly(box)
    assert as_it_is(registrar, image, wrong).corrected_box is None
    assert registrar([image], wrong[None])[0].corrected_box is None, "without a camera a pose keeps to its box"
    ranked = cr.Registrar(registrar.bank, pipeline=unrefined(registrar.bank))
    assert ranked([image], wrong[None], CAMERA)[0].corrected_box is None


@pytest.mark.parametrize("box", [[-300.0, -200.0, -100.0, -50.0], [torch.nan] * 4, [240.0, 10.0, 300.0, 90.0]])
def test_a_pose_that_left_the_photograph_corrects_nothing(registrar, monkeypatch, box):
    image, given, _ = scene(0)
    monkeypatch.setattr(correction, "projected_box", lambda *_: torch.tensor(box, dtype=torch.float64))
    assert registrar([image], given[None], CAMERA)[0].corrected_box is None


def test_boxes_are_compared_where_they_show_the_photograph():
    """An object cut off by the border has a box that ends there, its pose one that does not."""
    item = correction.ImageItem(torch.zeros(3, 100, 200), torch.tensor([150.0, 20.0, 199.5, 80.0]), CAMERA)
    same = torch.tensor([150.0, 20.0, 260.0, 80.0], dtype=torch.float64)
    assert not correction._differs(same, item)
    assert correction._differs(same - torch.tensor([20.0, 0.0, 20.0, 0.0]), item)
    low = correction.ImageItem(torch.zeros(3, 100, 200), torch.tensor([20.0, 50.0, 80.0, 99.5]), CAMERA)
    assert not correction._differs(torch.tensor([20.0, 50.0, 80.0, 300.0], dtype=torch.float64), low)
    assert correction._differs(torch.tensor([20.0, 30.0, 80.0, 300.0], dtype=torch.float64), low)


@pytest.mark.parametrize(("box", "another"), [((4, 10, 104, 60), False), ((12, 10, 112, 60), True)])
def test_boxes_that_overlap_by_85_per_cent_are_the_same(box, another):
    """Moved by 4 of 100 px they overlap by 0.92, moved by 12 by 0.79."""
    item = correction.ImageItem(torch.zeros(3, 80, 120), torch.tensor([0.0, 10.0, 100.0, 60.0]), CAMERA)
    assert correction._differs(torch.tensor(box, dtype=torch.float64), item) == another


def test_what_lies_outside_of_the_photograph_does_not_tell_boxes_apart():
    """A pose may reach far beyond the border that cut its box."""
    item = correction.ImageItem(torch.zeros(3, 80, 120), torch.tensor([-0.5, 10.0, 60.0, 79.5]), CAMERA)
    for beyond in ((-300.0, 10.0, 60.0, 79.5), (-0.5, 10.0, 60.0, 400.0)):
        assert not correction._differs(torch.tensor(beyond, dtype=torch.float64), item)
    assert correction._differs(torch.tensor([-300.0, 10.0, 20.0, 79.5], dtype=torch.float64), item)
    nowhere = torch.tensor([-300.0, 10.0, -20.0, 79.5], dtype=torch.float64)
    assert not correction._differs(nowhere, item)
