import pytest
import torch

from curvireg_torch.evaluation.benchmark import BenchmarkItem
from curvireg_torch.evaluation.scores import detection_recall

BOX = (10.0, 10.0, 30.0, 30.0)
AWAY = (150, 50, 160, 60)


def item(*box):
    return BenchmarkItem("", 0, None, (), torch.tensor(box), None)


def row(*boxes):
    proposals = [{"box": list(map(float, box)), "score": 0.5} for box in boxes]
    return {"detection": {"proposals": proposals}, "image_size": [100, 200]}


def test_detection_recall_counts_the_first_right_proposal():
    half, less = (10, 10, 30, 20), (10, 10, 30, 19.9)
    rows = [row(BOX), row(AWAY, half), row(*[AWAY] * 5, BOX), row(less), row(*[AWAY] * 20, BOX)]
    recall = detection_recall([item(*BOX)] * 5, rows)
    assert recall == {"n": 5, "recall_1": 0.2, "recall_5": 0.4, "recall_20": 0.6}


def test_detection_recall_counts_failures_but_no_unknown_boxes():
    recall = detection_recall(
        [item(*BOX), item(*[float("nan")] * 4), item(*BOX)], [row(BOX), row(AWAY), {"failed": "one colour"}]
    )
    assert (recall["n"], recall["recall_1"]) == (2, 0.5)
    assert detection_recall([], []) == {"n": 0, "recall_1": None, "recall_5": None, "recall_20": None}


@pytest.mark.parametrize(
    ("annotated", "proposed"),
    [
        ((-20.5, 10.0, 19.5, 50.0), (-0.5, 10.0, 19.5, 50.0)),
        ((-0.5, 10.0, 19.5, 50.0), (-20.5, 10.0, 19.5, 50.0)),
        ((10.0, 60.0, 30.0, 159.5), (10.0, 60.0, 30.0, 99.5)),
    ],
)
def test_detection_recall_clips_boxes_to_the_image(annotated, proposed):
    assert detection_recall([item(*annotated)], [row(proposed)])["recall_1"] == 1.0
