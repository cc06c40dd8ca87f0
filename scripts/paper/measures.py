"""Agreement of feature points, and means with their intervals, as the tables of the paper need
them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

Mask = NDArray[np.bool_]
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
    known = np.isfinite(np.asarray(values, dtype=np.float64))
    if not known.any():
        return Estimate(np.nan, np.nan, np.nan, 0)
    x = np.asarray(values, dtype=np.float64)[known]
    _, group = np.unique(np.asarray(groups)[known], return_inverse=True)
    sums = np.bincount(group, x)
    sizes = np.bincount(group)
    chosen = np.random.default_rng(0).integers(len(sums), size=(RESAMPLES, len(sums)))
    means = sums[chosen].sum(axis=1) / sizes[chosen].sum(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return Estimate(float(x.mean()), float(low), float(high), len(x))


def points_within(photo: Tensor, view: Tensor, eps_px: Sequence[float]) -> list[float]:
    """For each eps the fraction of the photograph's points (H, W) within eps px of a point of the
    view (H, W); NaN if the photograph has no points, 0 where only the view has none."""
    distances = _distances(photo.numpy(), view.numpy())
    return [float((distances <= eps).mean()) if len(distances) else np.nan for eps in eps_px]


def intersection_percentage(photo: Tensor, view: Tensor, *, eps_px: float = 2.0) -> float:
    """IP of the paper, in [0, 1]: see :func:`points_within`."""
    return points_within(photo, view, (eps_px,))[0]


def repeatability(view: Tensor, photo: Tensor, *, eps_px: float = 2.0) -> float:
    """Fraction of the view's points (H, W) within ``eps_px`` of a point of the photograph (H, W);
    NaN without any."""
    return points_within(view, photo, (eps_px,))[0]


def hausdorff_distance(a: Tensor, b: Tensor) -> float:
    """Hausdorff distance of two sets of points (H, W) in px: the largest distance of a point of
    either to the other set; ``inf`` where one set is empty and NaN where both are."""
    x = a.numpy()
    y = b.numpy()
    if not (x.any() and y.any()):
        return float(np.inf) if x.any() or y.any() else float(np.nan)
    return max(float(_distances(x, y).max()), float(_distances(y, x).max()))


def _distances(a: Mask, b: Mask) -> NDArray[np.float64]:
    """Distance from each point of ``a`` to the nearest point of ``b``; ``inf`` if ``b`` is
    empty."""
    if not b.any():
        return np.full(int(a.sum()), np.inf)
    to_b = distance_transform_edt(~b)
    return to_b[a]


def angle_differences(a: Tensor, b: Tensor) -> Tensor:
    """Absolute differences of (..., 3) azimuth, elevation and theta in degrees; the first and the
    last are circular."""
    difference = (a - b).abs()
    remainder = difference % 360.0
    circular = torch.tensor([True, False, True])
    return torch.where(circular, torch.minimum(remainder, 360.0 - remainder), difference)
