"""Boxes that are only roughly right are corrected."""

from dataclasses import replace

import pytest
import torch

from curvireg_torch.geometry import box_iou, rotation_error
from curvireg_torch.registration import correction
from curvireg_torch.registration.correction import projected_box
from curvireg_torch.registration.document import result_document, used_box
from curvireg_torch.registration.inputs import ImageItem
from tests._support.scenes import CAMERA, scene, truck_registrar

EDGES = torch.tensor([-0.1, 0.2, 0.1, 0.15])
"""Errors of a box's edges, as fractions of its sides."""
IMAGE, BOX, TRUTH = scene(0)
WRONG = BOX + EDGES * (BOX[2:] - BOX[:2]).repeat(2)


@pytest.fixture
def registrar():
    return truck_registrar()


def uncorrected(registrar, box):
    return registrar.register_items([ImageItem(IMAGE, box, CAMERA)])[0]


def test_wrong_box_is_corrected(registrar):
    result, before = registrar([IMAGE], WRONG[None], CAMERA)[0], uncorrected(registrar, WRONG)
    assert rotation_error(result.rotation, TRUTH[:3, :3]) < 2 < rotation_error(before.rotation, TRUTH[:3, :3])
    assert result.score > before.score
    assert torch.equal(result.corrected_box, projected_box(registrar, before).float().double())
    overlap = box_iou(torch.stack([result.corrected_box, WRONG.double()]), BOX[None].double())[:, 0]
    assert overlap[0] > overlap[1] + 0.1
    document = {**result_document(result, registrar, {}), "inputs": {"box": [1.0, 2.0, 3.0, 4.0]}}
    assert used_box(document) == document["corrected_box"] == result.corrected_box.tolist()
    assert used_box({**document, "corrected_box": None}) == [1.0, 2.0, 3.0, 4.0]


def test_correction_is_batch_independent(registrar):
    other, box, _ = scene(1)
    results = registrar([IMAGE, other, other], torch.stack([WRONG, box, box + 9e3]), CAMERA)
    assert [result.ok for result in results] == [True, True, False]
    alone = registrar([IMAGE], WRONG[None], CAMERA)[0]
    assert torch.equal(results[0].corrected_box, alone.corrected_box)
    assert torch.allclose(results[0].rotation, alone.rotation, atol=1e-9)
    assert results[1].corrected_box is None


def test_fitting_box_is_registered_once(registrar, monkeypatch):
    expected, calls = uncorrected(registrar, BOX), []
    monkeypatch.setattr(registrar, "register", lambda items, _: calls.append(len(items)) or [expected] * len(items))
    assert registrar([IMAGE], BOX[None], CAMERA)[0] is expected
    assert calls == [1]


@pytest.mark.parametrize("better", [True, False])
def test_corrected_result_is_kept_if_its_score_is_higher(registrar, monkeypatch, better):
    first = uncorrected(registrar, BOX)
    score = first.score + (0.01 if better else -0.01)
    other = replace(first, hypotheses=(replace(first.hypotheses[0], score=score),))
    answers = iter([[first], [other]])
    monkeypatch.setattr(registrar, "register_items", lambda *_, **__: next(answers))
    result = registrar([IMAGE], WRONG[None], CAMERA)[0]
    assert (result is first) != better
    assert (result.corrected_box is None) != better


def test_boxes_are_not_corrected_without_jitter_camera_or_search(registrar):
    assert truck_registrar(box_jitter=0.0)([IMAGE], WRONG[None], CAMERA)[0].corrected_box is None
    assert registrar([IMAGE], WRONG[None])[0].corrected_box is None
    quick = truck_registrar(search=False, contours=False)
    assert quick([IMAGE], WRONG[None], CAMERA)[0].corrected_box is None


@pytest.mark.parametrize("box", [[-300.0, -200.0, -100.0, -50.0], [torch.nan] * 4, [240.0, 10.0, 300.0, 90.0]])
def test_pose_outside_the_photograph_corrects_nothing(registrar, monkeypatch, box):
    monkeypatch.setattr(correction, "projected_box", lambda *_: torch.tensor(box, dtype=torch.float64))
    assert registrar([IMAGE], BOX[None], CAMERA)[0].corrected_box is None


@pytest.mark.parametrize(
    ("size", "given", "box", "expected"),
    [
        ((100, 200), (150.0, 20.0, 199.5, 80.0), (150.0, 20.0, 260.0, 80.0), False),  # cut off by the right border
        ((100, 200), (150.0, 20.0, 199.5, 80.0), (130.0, 20.0, 240.0, 80.0), True),
        ((100, 200), (20.0, 50.0, 80.0, 99.5), (20.0, 50.0, 80.0, 300.0), False),  # by the lower border
        ((100, 200), (20.0, 50.0, 80.0, 99.5), (20.0, 30.0, 80.0, 300.0), True),
        ((80, 120), (0.0, 10.0, 100.0, 60.0), (4.0, 10.0, 104.0, 60.0), False),  # IoU 0.92
        ((80, 120), (0.0, 10.0, 100.0, 60.0), (12.0, 10.0, 112.0, 60.0), True),  # IoU 0.79
        ((80, 120), (-0.5, 10.0, 60.0, 79.5), (-300.0, 10.0, 60.0, 79.5), False),  # by two borders
        ((80, 120), (-0.5, 10.0, 60.0, 79.5), (-0.5, 10.0, 60.0, 400.0), False),
        ((80, 120), (-0.5, 10.0, 60.0, 79.5), (-300.0, 10.0, 20.0, 79.5), True),
        ((80, 120), (-0.5, 10.0, 60.0, 79.5), (-300.0, 10.0, -20.0, 79.5), False),  # outside: not used
    ],
)
def test_boxes_are_compared_inside_the_photograph(size, given, box, expected):
    item = ImageItem(torch.zeros(3, *size), torch.tensor(given), CAMERA)
    assert correction._differs(torch.tensor(box, dtype=torch.float64), item) == expected
