"""Scores of the objects that were found without a box."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..geometry.crops import box_iou
from ..jobs.store import Row, Rows

MIN_IOU = 0.5  # intersection over union from which a box is right


def copy_shown(copies: Rows, row: Row) -> Row:
    """Of the ``copies`` of an object in a photograph, that which the box of a result overlaps most;
    the first one if it overlaps none. Where no box is given, each of them is a right answer."""
    if "rotation" not in row:
        return copies[0]
    boxes = torch.stack([copy["box"].double() for copy in copies])
    overlap = box_iou(boxes, torch.tensor([row["inputs"]["box"]], dtype=torch.float64))[
        :, 0
    ].nan_to_num(0.0)
    return copies[int(overlap.argmax())]


def detection_recall(copies: Sequence[Rows], rows: Rows) -> Row:
    """``recall_1``, ``recall_5``, ``recall_20``: fractions of ``n`` objects one of whose annotated
    ``copies`` is among the best proposals.

    Boxes are clipped to the image on both sides: some datasets annotate the visible part, some the
    whole object. A row that failed has no proposals, unless the object was not found among them.
    Recalls are None if no box is annotated.
    """
    ranks = []
    for group, row in zip(copies, rows, strict=True):
        if boxes := [copy["box"] for copy in group if bool(copy["box"].isfinite().all())]:
            ranks.append(min(_rank(box, row) for box in boxes))
    recalls = {
        f"recall_{k}": sum(rank <= k for rank in ranks) / len(ranks) if ranks else None
        for k in (1, 5, 20)
    }
    return {"n": len(ranks), **recalls}


def _rank(box: Tensor, row: Row) -> float:
    """Rank of the first right proposal, from 1; infinite if none is right."""
    if "detection" not in row:
        return math.inf
    boxes = [proposal["box"] for proposal in row["detection"]["proposals"]]
    proposals = torch.tensor(boxes, dtype=torch.float64).view(-1, 4)
    picture = row["inputs"]["picture"]
    end = torch.tensor([picture["width"], picture["height"]] * 2, dtype=torch.float64) - 0.5
    clipped = [
        torch.minimum(boxes.clamp(min=-0.5), end) for boxes in (proposals, box.double()[None])
    ]
    right = (box_iou(*clipped)[:, 0] >= MIN_IOU).nonzero()[:, 0]
    return float(right[0]) + 1 if len(right) else math.inf
