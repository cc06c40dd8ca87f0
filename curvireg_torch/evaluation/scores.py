"""Scores and tables that several benchmarks share."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from ..geometry import viewpoint_from_rotation
from ..metrics import accuracy, median_error
from ..utils.files import write_csv
from .store import Row

__all__ = ["THRESHOLDS", "estimated_rotations", "or_inf", "viewpoint_scores", "write_viewpoints"]

THRESHOLDS = {"acc_15_deg": 15.0, "acc_30_deg": 30.0}


def viewpoint_scores(errors: Tensor, thresholds: dict[str, float]) -> Row:
    """``n``, one accuracy for each threshold, and ``med_err_deg``.

    Args:
        errors: (N,) degrees, ``inf`` for a miss.
        thresholds: name of the accuracy -> degrees.

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
