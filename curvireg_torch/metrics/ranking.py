"""How good a ranking of the bank's views is, and how good it could have been.

"Precision at rank k" is not defined where it is printed, so both readings are here. With e(v) the rotation error of
view v of the bank, a query counts at rank k if

- *nearest* (``threshold_deg=None``): a view as near as the bank's nearest is among the first k;
- *threshold*: a view with e < threshold is among the first k.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_error, rotation_from_viewpoint
from curvireg_torch.utils.checks import check_finite, check_last_axes, check_positive, check_same_device, check_tensor

from ._samples import or_inf, share, shown

__all__ = ["closest_view", "pose_parameter_errors", "rank_precision", "viewpoint_differences"]

_SAME_DEG = 1e-2
"""Views nearer to each other than this have one rotation: float32 rotations are exact to about 1e-4 degrees."""


def rank_precision(
    order: Tensor, errors: Tensor, *, ks: Sequence[int] = (1, 3, 5, 10, 20), threshold_deg: float | None = None
) -> dict[int, float]:
    """Share of the queries that count at rank k, for each k.

    Args:
        order: (B, M) integers, the bank's views from best to worst; all N of them, or the first M >= min(max(ks), N).
        errors: (B, N) degrees, the rotation error of each view of the bank against the query's truth.
        ks: ranks >= 1; a rank beyond the bank looks at all of it.
        threshold_deg: None for the *nearest* definition (views of one rotation at several distances are all nearest),
            degrees > 0 for the *threshold* definition; an error equal to it does not count.

    Returns:
        ``{k: share in [0, 1]}``, NaN for B = 0.

    Raises:
        InvalidInputError: wrong shapes or dtypes, indices outside of the bank, negative, NaN or inf errors, bad ranks.

    Example:
        >>> order = torch.tensor([[2, 0, 1]])
        >>> errors = torch.tensor([[5.0, 90.0, 25.0]])
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
            f"order: expected integers of shape ({len(errors)}, {needed} to {n}), got {shown(order)}"
        )
    check_same_device(order, errors, "order")
    if n == 0:
        raise InvalidInputError("errors: expected a bank of at least one view, got none")
    if not bool(((errors >= 0) & errors.isfinite()).all()):  # all inf would be all nearest
        raise InvalidInputError("errors: expected degrees >= 0, got negative ones, inf or NaN")
    if not bool(((order >= 0) & (order < n)).all()):
        raise InvalidInputError(f"order: expected indices in [0, {n}), got some outside")
    best = errors.gather(1, order.long()).cummin(1).values
    smallest = {k: best[:, min(k, n) - 1] for k in ks}
    if threshold_deg is None:
        return {k: share(e <= errors.amin(1) + _SAME_DEG) for k, e in smallest.items()}
    return {k: share(e < threshold_deg) for k, e in smallest.items()}


def viewpoint_differences(a: Tensor, b: Tensor) -> Tensor:
    """Absolute differences of viewpoint parameters, angles taken the short way round the circle.

    Args:
        a, b: (..., 4) azimuth, elevation, theta (in-plane) in degrees and distance, broadcast against each other.

    Returns:
        (..., 4) in the same order; azimuth and theta in [0, 180].

    Raises:
        InvalidInputError: a last axis that is not 4 long.

    Example:
        >>> a, b = torch.tensor([350.0, 10.0, -170.0, 2.0]), torch.tensor([20.0, 30.0, 175.0, 1.5])
        >>> viewpoint_differences(a, b).tolist()
        [30.0, 20.0, 15.0, 0.5]
    """
    for name, x in (("a", a), ("b", b)):
        check_last_axes(x, name, (4,))
    difference = (a - b).abs()
    turn = difference % 360.0
    circular = torch.tensor([True, False, True, False], device=difference.device)
    return torch.where(circular, torch.minimum(turn, 360.0 - turn), difference)


def closest_view(views: Tensor, truth: Tensor) -> Tensor:
    """The view of the bank that the matcher ought to find: least rotation error, then nearest in distance.

    Args:
        views: (N, 4), N >= 1, azimuth, elevation, theta in degrees and distance of the bank's views.
        truth: (B, 4), the same of the queries.

    Returns:
        (B,) int64 indices into ``views``.

    Raises:
        InvalidInputError: wrong shapes, an empty bank, NaN or inf.

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
    """Mean absolute errors of the estimate (Est.) beside those of the bank's closest view (Clo.), as the paper's table.

    Args:
        estimate, truth: (B, 4) azimuth, elevation, theta in degrees and distance; NaN in ``estimate`` for a missing
            one, which makes the means of Est. infinite.
        views: (N, 4), the same of the bank's views.

    Returns:
        ``{"est": {...}, "clo": {...}}``, each with ``azimuth``, ``elevation`` and ``theta`` in degrees and ``distance``
        in the unit that came in; NaN for B = 0.

    Raises:
        InvalidInputError: wrong shapes, an empty bank, NaN or inf in ``truth`` or ``views``.

    Example:
        >>> truth = torch.tensor([[10.0, 5.0, 0.0, 1.0]])
        >>> views = torch.tensor([[0.0, 0.0, 0.0, 1.0], [20.0, 0.0, 0.0, 1.0], [40.0, 0.0, 0.0, 1.0]])
        >>> table = pose_parameter_errors(views[2:], truth, views)
        >>> table["est"]["azimuth"], table["clo"]["azimuth"]
        (30.0, 10.0)
    """
    check_tensor(truth, "truth", (None, 4))
    check_tensor(estimate, "estimate", (len(truth), 4))
    names = ("azimuth", "elevation", "theta", "distance")
    table = {}
    for key, view in (("est", estimate), ("clo", views[closest_view(views, truth)])):
        found = view.isfinite().all(1, keepdim=True)
        means = or_inf(viewpoint_differences(view, truth), found).double().mean(0)
        table[key] = dict(zip(names, means.tolist(), strict=True))
    return table
