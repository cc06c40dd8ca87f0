"""Scores and tables that several benchmarks share, and the recall of detected boxes."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..geometry import viewpoint_from_rotation
from ..geometry.crops import box_iou
from ..utils.files import write_csv
from .benchmark import BenchmarkItem, Row
from .metrics import accuracy, median_error

__all__ = [
    "THRESHOLDS",
    "detection_recall",
    "estimated_rotations",
    "or_inf",
    "viewpoint_scores",
    "write_viewpoints",
]

THRESHOLDS = {"acc_15_deg": 15.0, "acc_30_deg": 30.0}

MIN_IOU = 0.5
"""Intersection over union from which a box is right."""


def viewpoint_scores(errors: Tensor, thresholds: dict[str, float]) -> Row:
    """``n``, one accuracy for each threshold, and ``med_err_deg`` of errors (N,) in degrees, ``inf`` for a miss.

    Example:
        >>> viewpoint_scores(torch.tensor([5.0, 50.0]), {"acc_pi_6": 30.0})
        {'n': 2, 'acc_pi_6': 0.5, 'med_err_deg': 27.5}
    """
    accuracies = {name: accuracy(errors, degrees) for name, degrees in thresholds.items()}
    return {"n": len(errors), **accuracies, "med_err_deg": median_error(errors)}


def estimated_rotations(rows: Sequence[Row]) -> Tensor:
    """(N, 3, 3) float64; NaN for rows without an estimate."""
    missing = [[float("nan")] * 3] * 3
    return torch.tensor([row.get("rotation", missing) for row in rows], dtype=torch.float64).view(-1, 3, 3)


def or_inf(errors: Tensor, R: Tensor) -> Tensor:
    """``errors`` (N,), ``inf`` where the estimate ``R`` (N, 3, 3) is missing (NaN)."""
    return torch.where(R.isfinite().flatten(1).all(1), errors, torch.full_like(errors, torch.inf))


def detection_recall(items: Sequence[BenchmarkItem], rows: Sequence[Row]) -> Row:
    """``recall_1``, ``recall_5``, ``recall_20``: fractions of the ``n`` annotated boxes that the best proposals find.

    Boxes are clipped to the image on both sides: some datasets annotate the visible part, some the whole object. A row
    that failed has no proposals. Recalls are None if no box is annotated.
    """
    ranks = [_rank(item.box, row) for item, row in zip(items, rows, strict=True) if bool(item.box.isfinite().all())]
    recalls = {f"recall_{k}": sum(rank <= k for rank in ranks) / len(ranks) if ranks else None for k in (1, 5, 20)}
    return {"n": len(ranks), **recalls}


def _rank(box: Tensor, row: Row) -> float:
    """Rank of the first right proposal, from 1; infinite if none is right."""
    if "detection" not in row:
        return float("inf")
    boxes = [proposal["box"] for proposal in row["detection"]["proposals"]]
    proposals = torch.tensor(boxes, dtype=torch.float64).view(-1, 4)
    H, W = row["image_size"]
    end = torch.tensor([W, H, W, H], dtype=torch.float64) - 0.5
    clipped = [torch.minimum(boxes.clamp(min=-0.5), end) for boxes in (proposals, box.double()[None])]
    right = (box_iou(*clipped)[:, 0] >= MIN_IOU).nonzero()[:, 0]
    return float(right[0]) + 1 if len(right) else float("inf")


def write_viewpoints(
    path: Path,
    columns: Sequence[str],
    samples: Sequence[Row],
    rows: Sequence[Row],
    errors: Mapping[str, Tensor],
) -> None:
    """Write a table with one line for each object.

    Args:
        path: of the table.
        columns: keys of samples, rows and errors (N,); estimated angles; true angles as ``true_azimuth``, ...
        samples: annotations with ``viewpoint`` (3,), NaN where unknown.
        rows, errors: results, and degrees by column.
    """
    names = ("azimuth", "elevation", "theta")
    R = estimated_rotations(rows)
    lines: list[Sequence[object]] = [columns]
    for i, (sample, row) in enumerate(zip(samples, rows, strict=True)):
        line = {**sample, **row, "seconds": row["seconds"]["register"]}
        line |= {f"true_{name}": float(v) for name, v in zip(names, sample["viewpoint"], strict=True)}
        line |= {name: float(values[i]) for name, values in errors.items()}
        if "rotation" in row:
            line |= {n: float(v) for n, v in zip(names, viewpoint_from_rotation(R[i]), strict=True)}
        lines.append([_cell(line.get(name, "")) for name in columns])
    write_csv(path, lines)


def _cell(value: object) -> object:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return value
