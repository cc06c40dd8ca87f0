"""Numbers that both benchmarks print."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..metrics import accuracy, median_error

__all__ = ["estimated_rotations", "or_inf", "viewpoint_scores"]


def viewpoint_scores(errors: Tensor, thresholds: dict[str, float]) -> dict[str, Any]:
    """``n``, one share per threshold, and ``med_err_deg``.

    Args:
        errors: (N,) degrees, ``inf`` for a miss.
        thresholds: name of the share -> degrees.

    Example:
        >>> viewpoint_scores(torch.tensor([5.0, 50.0]), {"acc_pi_6": 30.0})
        {'n': 2, 'acc_pi_6': 0.5, 'med_err_deg': 27.5}
    """
    shares = {name: accuracy(errors, degrees) for name, degrees in thresholds.items()}
    return {"n": len(errors), **shares, "med_err_deg": median_error(errors)}


def estimated_rotations(rows: Sequence[dict[str, Any]]) -> Tensor:
    """(N, 3, 3) float64; NaN for rows without an estimate."""
    missing = [[float("nan")] * 3] * 3
    return torch.tensor([row.get("rotation", missing) for row in rows], dtype=torch.float64).view(-1, 3, 3)


def or_inf(errors: Tensor, R: Tensor) -> Tensor:
    """``errors`` (N,), ``inf`` where the estimate ``R`` (N, 3, 3) is missing (NaN)."""
    return torch.where(R.isfinite().flatten(1).all(1), errors, torch.full_like(errors, torch.inf))
