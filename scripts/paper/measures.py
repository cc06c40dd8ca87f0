"""Agreement of feature points, and means with their intervals, as the tables of the paper need
them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from torch import Tensor

RESAMPLES = 2000


@dataclass(frozen=True)
class Estimate:
    """A mean of ``n`` values with its 95 % interval."""

    mean: float
    low: float
    high: float
    n: int

    def __str__(self) -> str:
        digits = 0 if abs(self.mean) >= 100 else 1 if abs(self.mean) >= 10 else 2
        numbers = (f"{value:.{digits}f}" for value in (self.mean, self.low, self.high))
        return "-" if self.n == 0 else "{} ({} to {})".format(*numbers)


def bootstrap(values: Sequence[float], groups: Sequence[str]) -> Estimate:
    """Mean of the finite values, and its 95 % interval by 2000 resamples of whole groups (CADs),
    whose photographs are not independent; the same values give the same interval."""
    x = np.asarray(values, dtype=np.float64)
    known = np.isfinite(x)
    if not known.any():
        return Estimate(np.nan, np.nan, np.nan, 0)
    x = x[known]
    _, group = np.unique(np.asarray(groups)[known], return_inverse=True)
    sums = np.bincount(group, x)
    sizes = np.bincount(group)
    chosen = np.random.default_rng(0).integers(len(sums), size=(RESAMPLES, len(sums)))
    means = sums[chosen].sum(axis=1) / sizes[chosen].sum(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return Estimate(float(x.mean()), float(low), float(high), len(x))


def share_near(points: Tensor, others: Tensor, *, eps_px: float = 2.0) -> float:
    """Fraction of points (H, W) within ``eps_px`` of one of the others (H, W); NaN without points,
    0 without others.

    Of the points of a photograph near those of a view it is the paper's IP, of the points of a view
    near those of a photograph its repeatability.
    """
    chosen = points.numpy()
    if not chosen.any():
        return math.nan
    if not others.any():
        return 0.0
    distances = distance_transform_edt(~others.numpy())
    return float((distances[chosen] <= eps_px).mean())
