"""Agreement of feature points, and quality of a ranking of views, as the paper measures them."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from curvireg_torch.geometry import rotation_error, rotation_from_viewpoint

Mask = NDArray[np.bool_]


def intersection_percentage(photo: Tensor, view: Tensor, *, eps_px: float = 2.0) -> Tensor:
    """IP of the paper: fraction of the photograph's points within ``eps_px`` of a point of the view.

    Args:
        photo, view: (..., H, W) bool, one mask of feature points per image.
        eps_px: Euclidean radius >= 0 in px, inclusive.

    Returns:
        (...) in [0, 1]; NaN where the photograph has no points, 0 where only the view has none.
    """
    return _per_image(_fraction_within(eps_px), photo, view)


def view_repeatability(view: Tensor, photo: Tensor, *, eps_px: float = 2.0) -> Tensor:
    """Repeatability of a detector: fraction of the view's points within ``eps_px`` of a point of the photograph.

    This is :func:`intersection_percentage` with the roles exchanged; the paper's Rep, which ranks views, is not.
    """
    return _per_image(_fraction_within(eps_px), view, photo)


def hausdorff_distance(a: Tensor, b: Tensor, *, percentile: float = 100.0) -> Tensor:
    """Hausdorff distance of two point sets in pixels, or a percentile of it.

    ``h(A, B)`` is the percentile over a in A of the distance from a to the nearest point of B; the result is
    ``max(h(A, B), h(B, A))``. The classical distance (percentile 100) depends on a single point; 95 is robust.

    Args:
        a, b: (..., H, W) bool.
        percentile: in (0, 100], linear between order statistics.

    Returns:
        (...) px >= 0; ``inf`` where one mask is empty, NaN where both are.
    """

    def of_pair(x: Mask, y: Mask) -> float:
        if not (x.any() and y.any()):
            return np.inf if x.any() or y.any() else np.nan
        return max(float(np.percentile(_distances(*pair), percentile)) for pair in ((x, y), (y, x)))

    return _per_image(of_pair, a, b)


def _fraction_within(eps_px: float) -> Callable[[Mask, Mask], float]:
    return lambda a, b: float((_distances(a, b) <= eps_px).mean()) if a.any() else np.nan


def _distances(a: Mask, b: Mask) -> NDArray[np.float64]:
    """Distance from each point of ``a`` to the nearest point of ``b``; ``inf`` if ``b`` is empty."""
    if not b.any():
        return np.full(int(a.sum()), np.inf)
    to_b: NDArray[np.float64] = distance_transform_edt(~b)
    return to_b[a]


def _per_image(score: Callable[[Mask, Mask], float], a: Tensor, b: Tensor) -> Tensor:
    """``score`` of each pair of (..., H, W) masks, as a (...) tensor of the default dtype on their device."""
    shape = (a.shape[:-2].numel(), *a.shape[-2:])
    scores = [score(x, y) for x, y in zip(*(m.reshape(shape).cpu().numpy() for m in (a, b)), strict=True)]
    return torch.tensor(scores, dtype=torch.get_default_dtype(), device=a.device).reshape(a.shape[:-2])


SAME_DEGREES = 1e-2  # rotation errors closer than this count as equal


def rank_precision(
    order: Tensor, errors: Tensor, *, ks: Sequence[int] = (1, 3, 5, 10, 20), threshold_deg: float | None = None
) -> dict[int, float]:
    """Fraction of the queries that count at rank k, as ``{k: fraction}``; NaN for B = 0.

    Args:
        order: (B, M) integers, the views from best to worst: all N, or the first M >= min(max(ks), N).
        errors: (B, N) finite degrees >= 0, the rotation error of each view of the bank.
        ks: ranks >= 1; a rank above N counts as N.
        threshold_deg: None for the *nearest* definition (views of one rotation at several distances are all nearest),
            degrees > 0 for the *threshold* definition.
    """
    n = errors.shape[1]
    best = errors.gather(1, order.long()).cummin(1).values
    smallest = {k: best[:, min(k, n) - 1] for k in ks}
    if threshold_deg is None:
        return {k: float((e <= errors.amin(1) + SAME_DEGREES).double().mean()) for k, e in smallest.items()}
    return {k: float((e < threshold_deg).double().mean()) for k, e in smallest.items()}


def viewpoint_differences(a: Tensor, b: Tensor) -> Tensor:
    """Absolute differences of viewpoint parameters; azimuth and theta are circular, in [0, 180].

    Args:
        a, b: (..., 4) azimuth, elevation, theta (in-plane) in degrees and distance, broadcast against each other.
    """
    difference = (a - b).abs()
    remainder = difference % 360.0
    circular = torch.tensor([True, False, True, False], device=difference.device)
    return torch.where(circular, torch.minimum(remainder, 360.0 - remainder), difference)


def closest_view(views: Tensor, truth: Tensor) -> Tensor:
    """The best view of the bank, (B,) int64: the smallest rotation error, and among equal ones the nearest distance.

    Args:
        views: (N, 4), N >= 1, azimuth, elevation, theta in degrees and distance of the views of the bank.
        truth: (B, 4), the same for the queries.
    """
    error = rotation_error(
        rotation_from_viewpoint(*truth[:, :3].unbind(1)).unsqueeze(1), rotation_from_viewpoint(*views[:, :3].unbind(1))
    )
    nearest = error <= error.amin(1, keepdim=True) + SAME_DEGREES
    gap = (truth[:, 3:] - views[:, 3]).abs()
    return torch.where(nearest, gap, torch.full_like(gap, torch.inf)).argmin(1)


def pose_parameter_errors(estimate: Tensor, truth: Tensor, views: Tensor) -> dict[str, dict[str, float]]:
    """Mean absolute errors of the estimate (Est.) and of the closest view of the bank (Clo.), as in the paper.

    Args:
        estimate, truth: (B, 4) azimuth, elevation, theta in degrees and distance; NaN in ``estimate`` for a missing
            estimate, which makes the means of Est. infinite.
        views: (N, 4), the same for the views of the bank.

    Returns:
        ``{"est": {...}, "clo": {...}}``, each with ``azimuth``, ``elevation`` and ``theta`` in degrees and ``distance``
        in the input unit; NaN for B = 0.
    """
    names = ("azimuth", "elevation", "theta", "distance")
    table = {}
    for key, view in (("est", estimate), ("clo", views[closest_view(views, truth)])):
        valid = view.isfinite().all(1, keepdim=True)
        means = torch.where(valid, viewpoint_differences(view, truth), torch.inf).double().mean(0)
        table[key] = dict(zip(names, means.tolist(), strict=True))
    return table
