"""Agreement of feature points, and quality of a ranking of views, as the paper measures them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from curvireg_torch.geometry import rotation_error, rotation_from_viewpoint

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
    """Mean of the finite values, and its 95 % interval by 2000 resamples of whole groups (CADs), whose photographs are
    not independent; the same values give the same interval."""
    known = np.isfinite(np.asarray(values, dtype=np.float64))
    if not known.any():
        return Estimate(np.nan, np.nan, np.nan, 0)
    x = np.asarray(values, dtype=np.float64)[known]
    _, group = np.unique(np.asarray(groups)[known], return_inverse=True)
    sums, sizes = np.bincount(group, x), np.bincount(group)
    chosen = np.random.default_rng(0).integers(len(sums), size=(RESAMPLES, len(sums)))
    means = sums[chosen].sum(axis=1) / sizes[chosen].sum(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return Estimate(float(x.mean()), float(low), float(high), len(x))


def intersection_percentage(photo: Tensor, view: Tensor, *, eps_px: float = 2.0) -> Tensor:
    """IP of the paper, (...) in [0, 1]: fraction of the photograph's points (..., H, W) within ``eps_px`` of a point of
    the view; NaN where the photograph has no points, 0 where only the view has none. With the two exchanged, it is the
    repeatability of a detector."""
    return _per_image(lambda a, b: float((_distances(a, b) <= eps_px).mean()) if a.any() else np.nan, photo, view)


def hausdorff_distance(a: Tensor, b: Tensor) -> Tensor:
    """Hausdorff distance (...) of point sets (..., H, W) in px: the largest distance of a point of either to the other
    set; ``inf`` where one set is empty and NaN where both are."""

    def of_pair(x: Mask, y: Mask) -> float:
        if not (x.any() and y.any()):
            return np.inf if x.any() or y.any() else np.nan
        return max(float(_distances(*pair).max()) for pair in ((x, y), (y, x)))

    return _per_image(of_pair, a, b)


def _distances(a: Mask, b: Mask) -> NDArray[np.float64]:
    """Distance from each point of ``a`` to the nearest point of ``b``; ``inf`` if ``b`` is empty."""
    if not b.any():
        return np.full(int(a.sum()), np.inf)
    to_b: NDArray[np.float64] = distance_transform_edt(~b)
    return to_b[a]


def _per_image(score: Callable[[Mask, Mask], float], a: Tensor, b: Tensor) -> Tensor:
    """``score`` of each pair of (..., H, W) masks."""
    shape = (a.shape[:-2].numel(), *a.shape[-2:])
    scores = [score(x, y) for x, y in zip(*(m.reshape(shape).numpy() for m in (a, b)), strict=True)]
    return torch.tensor(scores, dtype=torch.get_default_dtype()).reshape(a.shape[:-2])


def rank_precision(order: Tensor, errors: Tensor, *, ks: Sequence[int], threshold_deg: float) -> dict[int, float]:
    """Fraction of the queries with a view within ``threshold_deg`` among the best k, as ``{k: fraction}``.

    ``order`` (B, M) are the views from best to worst, M >= min(max(ks), N), and ``errors`` (B, N) the rotation errors
    of all in degrees. A rank above N counts as N.
    """
    n = errors.shape[1]
    best = errors.gather(1, order.long()).cummin(1).values
    return {k: float((best[:, min(k, n) - 1] < threshold_deg).double().mean()) for k in ks}


def angle_differences(a: Tensor, b: Tensor) -> Tensor:
    """Absolute differences of (..., 3) azimuth, elevation and theta in degrees; the first and the last are circular."""
    difference = (a - b).abs()
    remainder = difference % 360.0
    circular = torch.tensor([True, False, True])
    return torch.where(circular, torch.minimum(remainder, 360.0 - remainder), difference)


def closest_view(views: Tensor, truth: Tensor) -> Tensor:
    """(B,) index of the view (N, 3) with the smallest rotation error to the truth (B, 3)."""
    true = rotation_from_viewpoint(*truth.unbind(1)).unsqueeze(1)
    return rotation_error(true, rotation_from_viewpoint(*views.unbind(1))).argmin(1)


def angle_errors(estimate: Tensor, truth: Tensor, views: Tensor) -> dict[str, dict[str, float]]:
    """Mean absolute errors of the estimate (Est.) and of the closest view of the bank (Clo.), as in the paper.

    ``estimate`` and ``truth`` (B, 3) are azimuth, elevation and theta in degrees, ``views`` (N, 3) those of the bank.
    """
    found = {"est": estimate, "clo": views[closest_view(views, truth)]}
    means = {key: angle_differences(view, truth).double().mean(0).tolist() for key, view in found.items()}
    return {key: dict(zip(("azimuth", "elevation", "theta"), values, strict=True)) for key, values in means.items()}
