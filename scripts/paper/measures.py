"""Agreement of feature points, and quality of a ranking of views, as the paper measures them."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from curvireg_torch.geometry import rotation_error, rotation_from_viewpoint

Mask = NDArray[np.bool_]
SAME_DEGREES = 1e-2  # rotation errors closer than this count as equal


def intersection_percentage(photo: Tensor, view: Tensor, *, eps_px: float = 2.0) -> Tensor:
    """IP of the paper, (...) in [0, 1]: fraction of the photograph's points (..., H, W) within ``eps_px`` of a point of
    the view; NaN where the photograph has no points, 0 where only the view has none."""
    return _per_image(lambda a, b: float((_distances(a, b) <= eps_px).mean()) if a.any() else np.nan, photo, view)


def view_repeatability(view: Tensor, photo: Tensor, *, eps_px: float = 2.0) -> Tensor:
    """Repeatability of a detector: fraction of the view's points within ``eps_px`` of a point of the photograph."""
    return intersection_percentage(view, photo, eps_px=eps_px)


def hausdorff_distance(a: Tensor, b: Tensor, *, percentile: float = 100.0) -> Tensor:
    """Hausdorff distance (...) of point sets (..., H, W) in px, or a percentile of it.

    ``h(A, B)`` is the percentile over a in A of the distance from a to the nearest point of B; the result is
    ``max(h(A, B), h(B, A))``, ``inf`` where one set is empty and NaN where both are.
    """

    def of_pair(x: Mask, y: Mask) -> float:
        if not (x.any() and y.any()):
            return np.inf if x.any() or y.any() else np.nan
        return max(float(np.percentile(_distances(*pair), percentile)) for pair in ((x, y), (y, x)))

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


def rank_precision(
    order: Tensor, errors: Tensor, *, ks: Sequence[int] = (1, 3, 5, 10, 20), threshold_deg: float | None = None
) -> dict[int, float]:
    """Fraction of the queries that count at rank k, as ``{k: fraction}``.

    Args:
        order: (B, M) the views from best to worst: all N, or the first M >= min(max(ks), N).
        errors: (B, N) degrees, the rotation error of each view of the bank.
        ks: ranks >= 1; a rank above N counts as N.
        threshold_deg: None: a query counts if the nearest view is among the first k; degrees: if one within them is.
    """
    n = errors.shape[1]
    best = errors.gather(1, order.long()).cummin(1).values
    smallest = {k: best[:, min(k, n) - 1] for k in ks}
    if threshold_deg is None:
        return {k: float((e <= errors.amin(1) + SAME_DEGREES).double().mean()) for k, e in smallest.items()}
    return {k: float((e < threshold_deg).double().mean()) for k, e in smallest.items()}


def viewpoint_differences(a: Tensor, b: Tensor) -> Tensor:
    """Absolute differences of (..., 4) azimuth, elevation, theta in degrees and distance; two angles are circular."""
    difference = (a - b).abs()
    remainder = difference % 360.0
    circular = torch.tensor([True, False, True, False])
    return torch.where(circular, torch.minimum(remainder, 360.0 - remainder), difference)


def closest_view(views: Tensor, truth: Tensor) -> Tensor:
    """(B,) index of the view (N, 4) with the smallest rotation error to the truth (B, 4), then the nearest distance."""
    error = rotation_error(
        rotation_from_viewpoint(*truth[:, :3].unbind(1)).unsqueeze(1), rotation_from_viewpoint(*views[:, :3].unbind(1))
    )
    nearest = error <= error.amin(1, keepdim=True) + SAME_DEGREES
    gap = (truth[:, 3:] - views[:, 3]).abs()
    return torch.where(nearest, gap, torch.full_like(gap, torch.inf)).argmin(1)


def pose_parameter_errors(estimate: Tensor, truth: Tensor, views: Tensor) -> dict[str, dict[str, float]]:
    """Mean absolute errors of the estimate (Est.) and of the closest view of the bank (Clo.), as in the paper.

    Args:
        estimate, truth: (B, 4) azimuth, elevation, theta in degrees and distance; NaN for a missing estimate.
        views: (N, 4), the same for the views of the bank.
    """
    names = ("azimuth", "elevation", "theta", "distance")
    table = {}
    for key, view in (("est", estimate), ("clo", views[closest_view(views, truth)])):
        valid = view.isfinite().all(1, keepdim=True)
        means = torch.where(valid, viewpoint_differences(view, truth), torch.inf).double().mean(0)
        table[key] = dict(zip(names, means.tolist(), strict=True))
    return table
