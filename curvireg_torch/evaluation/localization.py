"""Recall of boxes that are localized, not given."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..geometry.crops import box_iou
from .benchmark import BenchmarkItem, Row

__all__ = ["localization_recall"]

MIN_IOU = 0.5
"""Intersection over union from which a box is right."""

COUNTS = (1, 5, 20)


def localization_recall(items: Sequence[BenchmarkItem], rows: Sequence[Row]) -> Row:
    """Recall of annotated boxes by the best 1, 5 and 20 proposals, at an intersection over union of 0.5.

    Boxes are clipped to the image on both sides: some datasets annotate the visible part, some the whole object.

    Args:
        items: with their annotated boxes; unknown ones do not count.
        rows: their results; one that failed has no proposals.

    Returns:
        ``n``: known boxes; ``recall_1``, ``recall_5``, ``recall_20``: fractions of them, None if there are none.
    """
    ranks = [_rank(item.box, row) for item, row in zip(items, rows, strict=True) if bool(item.box.isfinite().all())]
    recalls = {f"recall_{k}": sum(rank <= k for rank in ranks) / len(ranks) if ranks else None for k in COUNTS}
    return {"n": len(ranks), **recalls}


def _rank(box: Tensor, row: Row) -> float:
    """Rank of the first right proposal, from 1; infinite if none is right."""
    if "localization" not in row:
        return float("inf")
    boxes = [proposal["box"] for proposal in row["localization"]["proposals"]]
    proposals = torch.tensor(boxes, dtype=torch.float64).view(-1, 4)
    H, W = row["image_size"]
    end = torch.tensor([W, H, W, H], dtype=torch.float64) - 0.5
    clipped = [torch.minimum(boxes.clamp(min=-0.5), end) for boxes in (proposals, box.double()[None])]
    right = (box_iou(*clipped)[:, 0] >= MIN_IOU).nonzero()[:, 0]
    return float(right[0]) + 1 if len(right) else float("inf")
