"""Recall of boxes, on boxes whose overlap is known."""

import torch

from curvireg_torch.evaluation.benchmark import BenchmarkItem
from curvireg_torch.evaluation.localisation import localisation


def item(*box):
    return BenchmarkItem(key="", index=0, meshes=(), box=torch.tensor(box), camera_matrix=None)


def row(*boxes):
    return {"localization": {"boxes": [list(map(float, box)) for box in boxes]}, "image_size": [100, 200]}


AWAY = (150, 50, 160, 60)


def test_the_first_right_proposal_decides():
    exact, half, less = (10, 10, 30, 30), (10, 10, 30, 20), (10, 10, 30, 19.9)
    items = [item(10.0, 10.0, 30.0, 30.0)] * 5
    rows = [row(exact), row(AWAY, half), row(*[AWAY] * 5, exact), row(less), row(*[AWAY] * 20, exact)]
    assert localisation(items, rows) == {"n": 5, "recall_1": 0.2, "recall_5": 0.4, "recall_20": 0.6}


def test_misses_count_and_unknown_boxes_do_not():
    nan = float("nan")
    items = [item(10.0, 10.0, 30.0, 30.0), item(nan, nan, nan, nan), item(10.0, 10.0, 30.0, 30.0)]
    rows = [row((10, 10, 30, 30)), row(AWAY), {"failed": "one colour"}]
    assert localisation(items, rows)["n"] == 2
    assert localisation(items, rows)["recall_1"] == 0.5
    assert localisation([], []) == {"n": 0, "recall_1": None, "recall_5": None, "recall_20": None}


def test_boxes_are_compared_within_the_picture():
    """Half of the object lies beyond the left border; whichever side says so, it is the same box."""
    whole, seen = (-20.5, 10.0, 19.5, 50.0), (-0.5, 10.0, 19.5, 50.0)
    for true, proposed in ((whole, seen), (seen, whole)):
        assert localisation([item(*true)], [row(proposed)])["recall_1"] == 1.0
    below, cut = (10.0, 60.0, 30.0, 159.5), (10.0, 60.0, 30.0, 99.5)
    assert localisation([item(*below)], [row(cut)])["recall_1"] == 1.0
