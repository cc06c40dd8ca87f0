"""How often a box is found that is not given."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..geometry.crops import box_iou
from .benchmark import BenchmarkItem, Row

__all__ = ["localisation"]

OVERLAP = 0.5
"""Intersection over union from which a box is right."""

COUNTS = (1, 5, 20)


def localisation(items: Sequence[BenchmarkItem], rows: Sequence[Row]) -> Row:
    """Recall of annotated boxes by the best 1, 5 and 20 proposals, at an intersection over union of 0.5.

    Boxes are cut to the picture on both sides: some sets annotate what is seen, some the whole object.

    Args:
        items: with their annotated boxes; unknown ones do not count.
        rows: their predictions; one that failed found nothing.

    Returns:
        ``n``: boxes that are known; ``recall_1``, ``recall_5``, ``recall_20``, None where there are none.
    """
    ranks = [_rank(item.box, row) for item, row in zip(items, rows, strict=True) if bool(item.box.isfinite().all())]
    shares = {f"recall_{k}": sum(rank <= k for rank in ranks) / len(ranks) if ranks else None for k in COUNTS}
    return {"n": len(ranks), **shares}


def _rank(box: Tensor, row: Row) -> float:
    """Place of the first proposal that is right, from 1; infinite if none is."""
    if "localization" not in row:
        return float("inf")
    proposals = torch.tensor(row["localization"]["boxes"], dtype=torch.float64).view(-1, 4)
    H, W = row["image_size"]
    end = torch.tensor([W, H, W, H], dtype=torch.float64) - 0.5
    cut = [torch.minimum(boxes.clamp(min=-0.5), end) for boxes in (proposals, box.double()[None])]
    right = (box_iou(*cut)[:, 0] >= OVERLAP).nonzero()[:, 0]
    return float(right[0]) + 1 if len(right) else float("inf")
