"""Quality of a ranking of the views of a bank, and the best quality that the bank allows.

"Precision at rank k" has two definitions in use. With e(v) the rotation error of view v, a query counts at rank k if

- *nearest* (``threshold_deg=None``): one of the first k views is as near as the nearest view of the bank;
- *threshold*: one of the first k views has e < threshold.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry import rotation_error, rotation_from_viewpoint
from ..utils.checks import (
    check_finite,
    check_last_axes,
    check_positive,
    check_same_device,
    check_tensor,
    type_and_shape,
)
from .checks import fraction_true, inf_unless

_SAME_DEG = 1e-2
"""Rotation errors closer than this count as equal; float32 rotations are exact to about 1e-4 degrees."""


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

    Example:
        >>> order, errors = torch.tensor([[2, 0, 1]]), torch.tensor([[5.0, 90.0, 25.0]])
        >>> rank_precision(order, errors, ks=(1, 3)), rank_precision(order, errors, ks=(1, 3), threshold_deg=30.0)
        ({1: 0.0, 3: 1.0}, {1: 1.0, 3: 1.0})
    """
    if len(ks) == 0 or any(k < 1 for k in ks):
        raise InvalidInputError(f"ks: expected ranks >= 1, got {tuple(ks)}")
    if threshold_deg is not None:
        check_positive(threshold_deg, "threshold_deg")
    check_tensor(errors, "errors", (None, None))
    n = errors.shape[1]
    needed = min(max(ks), n)
    integers = isinstance(order, Tensor) and not order.is_floating_point() and order.dtype != torch.bool
    if not integers or order.ndim != 2 or len(order) != len(errors) or not needed <= order.shape[1] <= n:
        raise InvalidInputError(
            f"order: expected integers of shape ({len(errors)}, {needed} to {n}), got {type_and_shape(order)}"
        )
    check_same_device(order, errors, "order")
    if n == 0:
        raise InvalidInputError("errors: expected a bank of at least one view, got none")
    if not bool(((errors >= 0) & errors.isfinite()).all()):  # if all were inf, all views would be nearest
        raise InvalidInputError("errors: expected degrees >= 0, got negative ones, inf or NaN")
    if not bool(((order >= 0) & (order < n)).all()):
        raise InvalidInputError(f"order: expected indices in [0, {n}), got some outside")
    best = errors.gather(1, order.long()).cummin(1).values
    smallest = {k: best[:, min(k, n) - 1] for k in ks}
    if threshold_deg is None:
        return {k: fraction_true(e <= errors.amin(1) + _SAME_DEG) for k, e in smallest.items()}
    return {k: fraction_true(e < threshold_deg) for k, e in smallest.items()}


def viewpoint_differences(a: Tensor, b: Tensor) -> Tensor:
    """Absolute differences of viewpoint parameters; azimuth and theta are circular, in [0, 180].

    Args:
        a, b: (..., 4) azimuth, elevation, theta (in-plane) in degrees and distance, broadcast against each other.

    Example:
        >>> a, b = torch.tensor([350.0, 10.0, -170.0, 2.0]), torch.tensor([20.0, 30.0, 175.0, 1.5])
        >>> viewpoint_differences(a, b).tolist()
        [30.0, 20.0, 15.0, 0.5]
    """
    for name, x in (("a", a), ("b", b)):
        check_last_axes(x, name, (4,))
    difference = (a - b).abs()
    remainder = difference % 360.0
    circular = torch.tensor([True, False, True, False], device=difference.device)
    return torch.where(circular, torch.minimum(remainder, 360.0 - remainder), difference)


def closest_view(views: Tensor, truth: Tensor) -> Tensor:
    """The best view of the bank, (B,) int64: the smallest rotation error, and among equal ones the nearest distance.

    Args:
        views: (N, 4), N >= 1, azimuth, elevation, theta in degrees and distance of the views of the bank.
        truth: (B, 4), the same for the queries.

    Example:
        >>> views = torch.tensor([[0.0, 0.0, 0.0, 1.0], [90.0, 0.0, 0.0, 1.0], [90.0, 0.0, 0.0, 2.0]])
        >>> closest_view(views, torch.tensor([[80.0, 5.0, 0.0, 1.9]])).tolist()
        [2]
    """
    check_tensor(views, "views", (None, 4))
    check_tensor(truth, "truth", (None, 4))
    check_finite(views, "views")
    check_finite(truth, "truth")
    if len(views) == 0:
        raise InvalidInputError("views: expected at least one view, got none")
    error = rotation_error(
        rotation_from_viewpoint(*truth[:, :3].unbind(1)).unsqueeze(1), rotation_from_viewpoint(*views[:, :3].unbind(1))
    )
    nearest = error <= error.amin(1, keepdim=True) + _SAME_DEG
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

    Example:
        >>> views = torch.tensor([[0.0, 0.0, 0.0, 1.0], [20.0, 0.0, 0.0, 1.0], [40.0, 0.0, 0.0, 1.0]])
        >>> table = pose_parameter_errors(views[2:], torch.tensor([[10.0, 5.0, 0.0, 1.0]]), views)
        >>> table["est"]["azimuth"], table["clo"]["azimuth"]
        (30.0, 10.0)
    """
    check_tensor(truth, "truth", (None, 4))
    check_tensor(estimate, "estimate", (len(truth), 4))
    names = ("azimuth", "elevation", "theta", "distance")
    table = {}
    for key, view in (("est", estimate), ("clo", views[closest_view(views, truth)])):
        valid = view.isfinite().all(1, keepdim=True)
        means = inf_unless(valid, viewpoint_differences(view, truth)).double().mean(0)
        table[key] = dict(zip(names, means.tolist(), strict=True))
    return table
