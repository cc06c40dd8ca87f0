import dataclasses
import itertools
import math

import numpy as np
import pytest
import torch

from curvireg_torch import metrics
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_from_viewpoint, viewpoint_from_rotation

from .helpers import rotations

SQUARE = torch.tensor([0.0, 0.0, 10.0, 10.0])


def _objects(azimuths: list[float], *, image: list[int] | None = None) -> metrics.Objects:
    """One 10 px square per object, objects of one image side by side, 20 px apart."""
    image = list(range(len(azimuths))) if image is None else image
    place = torch.tensor([20.0 * image[:i].count(image[i]) for i in range(len(image))])
    shift = torch.stack([place, torch.zeros_like(place)] * 2, 1)
    return metrics.Objects(torch.tensor(image), SQUARE + shift, rotation_from_viewpoint(torch.tensor(azimuths), 10.0))


def _detections(objects: metrics.Objects, scores: list[float], azimuths: list[float]) -> metrics.Detections:
    R = rotation_from_viewpoint(torch.tensor(azimuths), 10.0)
    return metrics.Detections(objects.image, objects.boxes, R, torch.tensor(scores))


def test_ground_truth_boxes_with_equal_scores_give_the_binned_accuracy() -> None:
    truth = torch.tensor([0.0, 50.0, 100.0, 200.0, 300.0])
    guess = truth + torch.tensor([2.0, 180.0, -3.0, 90.0, 5.0])
    objects = _objects(truth.tolist())
    detections = _detections(objects, [1.0] * 5, guess.tolist())
    for bins in metrics.AVP_BINS:
        expected = metrics.binned_accuracy(guess % 360.0, truth, bins)
        assert metrics.average_viewpoint_precision(detections, objects, bins) == pytest.approx(expected)
    assert metrics.average_precision(detections, objects) == 1.0
    assert metrics.average_rotation_precision(detections, objects) == pytest.approx(3 / 5)


def test_worked_example() -> None:
    # Scores 4 > 3 > 2 > 1; viewpoint right, wrong, right, right; of 4 boxes all are found.
    # Recall 1/4, 2/4, 3/4, 4/4 at heights 1, 1/2, 2/3, 3/4, made monotone 1, 3/4, 3/4, 3/4.
    objects = _objects([0.0, 90.0, 180.0, 270.0])
    detections = _detections(objects, [4.0, 3.0, 2.0, 1.0], [0.0, 0.0, 180.0, 270.0])
    expected = (1 + 3 * 0.75) / 4
    assert metrics.average_viewpoint_precision(detections, objects, 4) == pytest.approx(expected)
    assert metrics.average_rotation_precision(detections, objects) == pytest.approx(expected)


def test_second_claim_of_a_box_and_poor_overlap_are_false() -> None:
    objects = _objects([0.0, 0.0], image=[7, 7])
    half = SQUARE + torch.tensor([0.0, 0.0, 10.0, 0.0])  # twice as wide: IoU exactly 1/2
    poor = SQUARE + torch.tensor([20.0, 0.0, 30.1, 0.0])  # IoU just below 1/2
    boxes = torch.stack([half, SQUARE, poor])
    R, scores = objects.rotations[[0, 0, 0]], torch.tensor([3.0, 2.0, 1.0])
    detections = metrics.Detections(torch.tensor([7, 7, 7]), boxes, R, scores)
    assert metrics.average_precision(detections, objects) == pytest.approx(0.5)
    elsewhere = metrics.Detections(torch.tensor([8, 8, 8]), boxes, R, scores)
    assert metrics.average_precision(elsewhere, objects) == 0.0


def test_order_of_ties_and_of_the_rows_does_not_matter() -> None:
    objects = _objects([0.0, 90.0, 180.0, 270.0])
    detections = _detections(objects, [1.0, 1.0, 2.0, 1.0], [0.0, 0.0, 180.0, 0.0])
    shuffled = metrics.Detections(
        *(x[[3, 1, 0, 2]] for x in (detections.image, detections.boxes, detections.rotations, detections.scores))
    )
    value = metrics.average_viewpoint_precision(detections, objects, 8)
    assert value == metrics.average_viewpoint_precision(shuffled, objects, 8)
    assert value == pytest.approx(1 / 4 * 1 + 3 / 4 * 2 / 4)


def _score_all(detections: metrics.Detections, objects: metrics.Objects) -> list[float]:
    return [
        metrics.average_precision(detections, objects),
        metrics.average_viewpoint_precision(detections, objects, 8),
        metrics.average_rotation_precision(detections, objects),
    ]


def _listed(rows: metrics.Objects, order: tuple[int, ...]) -> metrics.Objects:
    return type(rows)(*(getattr(rows, f.name)[list(order)] for f in dataclasses.fields(rows)))


def test_ties_that_compete_for_a_box_share_it() -> None:
    """Three detections of one box and one score, of which two are right; a better one of another box before them."""
    objects = _objects([0.0, 90.0], image=[0, 0])
    boxes = objects.boxes[[1, 0, 0, 0]] + torch.tensor([[0.0], [0.0], [0.5], [-0.5]])
    R = rotation_from_viewpoint(torch.tensor([90.0, 0.0, 180.0, 3.0]), 10.0)
    scores = torch.tensor([2.0, 1.0, 1.0, 1.0])
    detections = metrics.Detections(torch.zeros(4, dtype=torch.int64), boxes, R, scores)
    for order in itertools.permutations(range(4)):
        # Recall 1/2, 1 at heights 1, (1 + 2/3) / 4; of the boxes alone 1, 2/4.
        expected = [0.5 + 0.5 * 2 / 4, *[0.5 + 0.5 * (1 + 2 / 3) / 4] * 2]
        assert _score_all(_listed(detections, order), objects) == pytest.approx(expected, abs=1e-12)
    # A later one finds the box taken, whoever of the three had it.
    late = metrics.Detections(
        torch.zeros(5, dtype=torch.int64),
        torch.cat([boxes, objects.boxes[:1]]),
        torch.cat([R, objects.rotations[:1]]),
        torch.cat([scores, torch.tensor([0.5])]),
    )
    assert _score_all(late, objects) == pytest.approx(expected, abs=1e-12)


def test_the_order_of_objects_that_a_box_overlaps_equally_does_not_matter() -> None:
    image, same = torch.zeros(3, dtype=torch.int64), SQUARE.expand(3, 4).clone()
    same[2] += 3.0
    objects = metrics.Objects(image, same, rotation_from_viewpoint(torch.tensor([0.0, 90.0, 180.0]), 10.0))
    detections = metrics.Detections(
        image, same, rotation_from_viewpoint(torch.tensor([0.0, 0.0, 180.0]), 10.0), torch.tensor([3.0, 2.0, 1.0])
    )
    values = [_score_all(detections, _listed(objects, order)) for order in itertools.permutations(range(3))]
    assert all(value == values[0] for value in values)


def test_against_a_slow_loop() -> None:
    rng = np.random.default_rng(0)
    n, m = 60, 25
    gt_image, image = rng.integers(0, 6, m), rng.integers(0, 6, n)
    gt_boxes = np.concatenate([c := rng.uniform(0, 30, (m, 2)), c + rng.uniform(10, 30, (m, 2))], 1)
    boxes = np.concatenate([c := rng.uniform(0, 30, (n, 2)), c + rng.uniform(10, 30, (n, 2))], 1)
    for i in range(0, n, 2):  # half of the detections lie near an object
        j = rng.integers(m)
        image[i], boxes[i] = gt_image[j], gt_boxes[j] + rng.normal(size=4)
    R_gt, scores = rotations(m, 1), rng.permutation(n).astype(float)
    R = R_gt[rng.integers(0, m, n)]

    taken, tp, right, curve = set(), 0, 0, []
    for rank, i in enumerate(np.argsort(-scores), start=1):
        best, best_iou = -1, 0.0
        for j in np.flatnonzero(gt_image == image[i]):
            w = min(boxes[i, 2], gt_boxes[j, 2]) - max(boxes[i, 0], gt_boxes[j, 0])
            h = min(boxes[i, 3], gt_boxes[j, 3]) - max(boxes[i, 1], gt_boxes[j, 1])
            if w > 0 and h > 0:
                areas = sum((b[2] - b[0]) * (b[3] - b[1]) for b in (boxes[i], gt_boxes[j]))
                if (iou := w * h / (areas - w * h)) > best_iou:
                    best, best_iou = int(j), iou
        if best_iou >= 0.5 and best not in taken:
            taken.add(best)
            tp += 1
            a, b = (float(viewpoint_from_rotation(x)[0]) for x in (R[i], R_gt[best]))
            right += round(a / 90) % 4 == round(b / 90) % 4
        curve.append((tp / m, right / rank))
    area, last = 0.0, 0.0
    for k, (recall, _) in enumerate(curve):
        area += (recall - last) * max(height for _, height in curve[k:])
        last = recall

    detections = metrics.Detections(*map(torch.from_numpy, (image, boxes)), R, torch.from_numpy(scores))
    objects = metrics.Objects(*map(torch.from_numpy, (gt_image, gt_boxes)), R_gt)
    assert 0.0 < area < 1.0
    assert metrics.average_viewpoint_precision(detections, objects, 4) == pytest.approx(area)


def test_empty_sides_and_bad_input() -> None:
    objects = _objects([0.0, 90.0])
    none = metrics.Objects(objects.image[:0], objects.boxes[:0], objects.rotations[:0])
    no_detections = metrics.Detections(none.image, none.boxes, none.rotations, torch.empty(0))
    detections = _detections(objects, [1.0, 2.0], [0.0, 0.0])
    assert metrics.average_viewpoint_precision(no_detections, objects, 4) == 0.0
    assert math.isnan(metrics.average_rotation_precision(detections, none))
    with pytest.raises(InvalidInputError, match="image: expected an integer"):
        metrics.Objects(objects.image.float(), objects.boxes, objects.rotations)
    with pytest.raises(InvalidInputError, match="boxes: expected shape"):
        metrics.Objects(objects.image, objects.boxes[:1], objects.rotations)
    with pytest.raises(InvalidInputError, match="scores: expected finite"):
        _detections(objects, [1.0, math.nan], [0.0, 0.0])
    with pytest.raises(InvalidInputError, match="threshold_deg"):
        metrics.average_rotation_precision(detections, objects, threshold_deg=-1.0)


def test_scores_that_are_nearly_equal_are_no_tie() -> None:
    """A right detection before a false one is worth 1, in a tie with it 1/2, however small the lead."""
    objects = _objects([0.0])
    R, image = objects.rotations[[0, 0]], torch.tensor([0, 0])
    boxes = torch.stack([SQUARE, SQUARE + 100.0])
    for lead, expected in ((1e-6, 1.0), (0.0, 0.5)):
        scores = torch.tensor([0.5 + lead, 0.5], dtype=torch.float64)
        found = metrics.Detections(image, boxes.double(), R, scores)
        assert metrics.average_precision(found, objects) == pytest.approx(expected)
