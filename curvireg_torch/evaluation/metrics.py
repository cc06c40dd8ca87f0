"""Errors and recalls of 6D poses (ADD, ADD-S, MSSD, MSPD) and of viewpoints, as functions of a
whole set.

An average over no items is NaN. A missing estimate, a pose of NaN, has the error ``inf`` and counts
as a miss. Thresholds are strict: an error equal to the threshold is a miss.
"""

import math
from collections.abc import Callable, Sequence
from functools import reduce
from statistics import median

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry import rotation_error, transform
from ..utils.checks import (
    as_numbers,
    check_camera_matrix,
    check_finite,
    check_pose,
    check_rotation,
    check_symmetries,
    check_tensor,
)
from ..utils.precision import full_precision

__all__ = [
    "ADD_THRESHOLDS",
    "MSPD_THRESHOLDS",
    "MSSD_THRESHOLDS",
    "add_error",
    "adds_error",
    "average_recall",
    "median_error",
    "mspd_error",
    "mssd_error",
    "symmetric_rotation_error",
]

BOUNDING_POINTS = 300  # points by which symmetries are compared before all points are
_CHUNK = 1 << 22  # points transformed at once: 50 MB of float32 coordinates
ADD_THRESHOLDS = (0.1,)  #: diameters: a pose with a smaller ADD or ADD-S is right
#: diameters of BOP's average recall of MSSD
MSSD_THRESHOLDS = tuple(step / 20.0 for step in range(1, 11))

MSPD_THRESHOLDS = tuple(5.0 * step / 640.0 for step in range(1, 11))
"""Image widths of BOP's average recall of MSPD: 5, 10, ..., 50 px times width / 640."""


@full_precision()
def add_error(T_est: Tensor, T_gt: Tensor, points: Tensor) -> Tensor:
    """ADD (Hinterstoisser et al. 2012): mean over the points x of ``|T_est x - T_gt x|``.

    Args:
        T_est, T_gt: (B, 4, 4) rigid model -> camera; NaN in ``T_est`` for a missing estimate.
        points: (P, 3) on the model's surface, P >= 1.

    Returns:
        (B,) in the unit of the points, ``inf`` for a missing estimate.

    Example:
        >>> T = torch.eye(4)[None]
        >>> moved = T.clone(); moved[0, 2, 3] = 0.5
        >>> add_error(moved, T, torch.rand(10, 3)).tolist()
        [0.5]
    """
    T_est, T_gt, points, valid = _checked(T_est, T_gt, points)
    means = [_transform(d, points).norm(dim=1).mean(1) for d in _chunks(T_est - T_gt, points)]
    return torch.cat(means).where(valid, torch.inf)


@full_precision()
def adds_error(T_est: Tensor, T_gt: Tensor, points: Tensor) -> Tensor:
    """ADD-S: mean over the points x of the distance of ``T_gt x`` to the nearest ``T_est y``.

    Arguments and result are those of :func:`add_error`. Computed in float64 on the CPU with one k-d
    tree in the model frame, since rigid poses preserve distances.

    Example:
        >>> T = torch.eye(4)[None]
        >>> half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))[None]
        >>> adds_error(half_turn, T, torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])).tolist()
        [0.0]
    """
    T_est, T_gt, points, valid = _checked(T_est, T_gt, points)
    model = points.detach().cpu().double()
    tree = cKDTree(model.numpy())
    back = torch.linalg.solve(T_est.detach().cpu().double(), T_gt.detach().cpu().double())
    means = [float(tree.query((model @ T[:3, :3].T + T[:3, 3]).numpy())[0].mean()) for T in back]
    return T_est.new_tensor(means).where(valid, torch.inf)


@full_precision()
def mssd_error(
    T_est: Tensor, T_gt: Tensor, points: Tensor, *, symmetries: Tensor | None = None
) -> Tensor:
    """MSSD (Hodan et al. 2020): minimum over the symmetries S of the maximum over x of
    ``|T_est x - T_gt S x|``.

    Args:
        T_est, T_gt, points: as in :func:`add_error`.
        symmetries: (S, 4, 4) or (S, 3, 3) of the model, S >= 1, with the identity, as those of
            :func:`curvireg_torch.geometry.symmetry_transforms`; None: only the identity.

    Example:
        >>> T = torch.eye(4)[None]
        >>> half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))[None]
        >>> points = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
        >>> mssd_error(half_turn, T, points, symmetries=torch.cat([T, half_turn])).tolist()
        [0.0]
    """
    T_est, T_gt, points, valid = _checked(T_est, T_gt, points)
    difference = T_est.unsqueeze(1) - T_gt.unsqueeze(1) @ _checked_symmetries(symmetries, T_gt)

    def largest(which: Tensor, points: Tensor) -> Tensor:
        moved = difference.flatten(0, 1)[which]
        return torch.cat(
            [_transform(d, points).norm(dim=1).amax(1) for d in _chunks(moved, points)]
        )

    return _least_maximum(largest, difference.shape[:2], points).where(valid, torch.inf)


@full_precision()
def mspd_error(
    T_est: Tensor,
    T_gt: Tensor,
    points: Tensor,
    camera_matrix: Tensor,
    *,
    symmetries: Tensor | None = None,
) -> Tensor:
    """MSPD (Hodan et al. 2020): as MSSD, of the points projected into the image.

    Args:
        T_est, T_gt, points, symmetries: as in :func:`mssd_error`.
        camera_matrix: (B, 3, 3) or (3, 3) in px.

    Returns:
        (B,) px; ``inf`` where a point is not in front of the camera.

    Example:
        >>> T = torch.eye(4)[None]; T[0, 2, 3] = 2.0
        >>> moved = T.clone(); moved[0, 0, 3] = 0.1
        >>> K = torch.tensor([[100.0, 0.0, 32.0], [0.0, 100.0, 32.0], [0.0, 0.0, 1.0]])
        >>> round(float(mspd_error(moved, T, torch.zeros(1, 3), K)), 3)       # 100 px * 0.1 / 2
        5.0
    """
    T_est, T_gt, points, valid = _checked(T_est, T_gt, points)
    batch = () if getattr(camera_matrix, "ndim", 0) == 2 else (len(T_est),)
    check_tensor(camera_matrix, "camera_matrix", (*batch, 3, 3))
    check_camera_matrix(camera_matrix)
    K = camera_matrix.to(T_est.dtype).unsqueeze(-3)
    true = K @ (T_gt.unsqueeze(1) @ _checked_symmetries(symmetries, T_gt))[:, :, :3]
    estimated = (K @ T_est.unsqueeze(1)[:, :, :3]).expand_as(true)

    def largest(which: Tensor, points: Tensor) -> Tensor:
        found = []
        for some in _chunks(which, points):
            (xy_a, front_a), (xy_b, front_b) = (
                _project(p.flatten(0, 1)[some], points) for p in (estimated, true)
            )
            distances = (xy_a - xy_b).norm(dim=1).where(front_a & front_b, torch.inf)
            found.append(distances.amax(1))
        return torch.cat(found)

    return _least_maximum(largest, true.shape[:2], points).where(valid, torch.inf)


def _least_maximum(
    largest: Callable[[Tensor, Tensor], Tensor], shape: Sequence[int], points: Tensor
) -> Tensor:
    """(B,) minima over S symmetries of the largest distance of a point, for a ``shape`` of (B, S).

    ``largest`` maps indices (M,) into the flattened ``shape``, and some points, to the largest
    distances (M,). A few of the points bound the maximum of all from below; all are compared only
    where a bound is the least one.
    """
    everything = torch.arange(shape[0] * shape[1], device=points.device)
    distances = largest(everything, points[:: max(1, len(points) // BOUNDING_POINTS)]).view(*shape)
    exact = torch.zeros_like(distances, dtype=torch.bool)
    row = torch.arange(shape[0], device=points.device)
    while True:
        best = distances.argmin(dim=1)
        open_rows = (~exact[row, best]).nonzero()[:, 0]
        if len(open_rows) == 0:
            return distances.amin(dim=1)
        chosen = best[open_rows]
        distances[open_rows, chosen] = largest(open_rows * shape[1] + chosen, points)
        exact[open_rows, chosen] = True


def average_recall(errors: Tensor, thresholds: Sequence[float]) -> float:
    """Fraction of the errors (N,) below a threshold, averaged over the thresholds in the same unit;
    NaN for N = 0.

    With one threshold of 30 or 10 degrees it is Acc(pi/6) or Acc(pi/18).

    Example:
        >>> # below 0.30, 0.35, 0.40, 0.45 and 0.50
        >>> average_recall(torch.tensor([0.26]), MSSD_THRESHOLDS)
        0.5
    """
    _check_errors(errors)
    limits = as_numbers(thresholds, "thresholds", dtype=torch.float64).flatten().tolist()
    if not limits:
        raise InvalidInputError("thresholds: expected at least one number, got none")
    return sum(float((errors < limit).double().mean()) for limit in limits) / len(limits)


def _checked(T_est: Tensor, T_gt: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """In the widest of their dtypes, at least float32, missing estimates replaced by the truth; and
    a mask of valid estimates."""
    check_tensor(T_est, "T_est", (None, 4, 4))
    check_tensor(T_gt, "T_gt", (len(T_est), 4, 4))
    check_tensor(points, "points", (None, 3))
    if len(points) == 0:
        raise InvalidInputError("points: expected at least one point, got none")
    check_finite(points, "points")
    check_pose(T_gt, "T_gt")
    dtype = reduce(torch.promote_types, (T_est.dtype, T_gt.dtype, points.dtype), torch.float32)
    T_est, T_gt, points = (x.to(dtype) for x in (T_est, T_gt, points))
    valid = T_est.isfinite().flatten(1).all(1)
    T_est = torch.where(valid.view(-1, 1, 1), T_est, T_gt)
    check_pose(T_est, "T_est")
    return T_est, T_gt, points, valid


def _checked_symmetries(symmetries: Tensor | None, like: Tensor) -> Tensor:
    if symmetries is None:
        return torch.eye(4, dtype=like.dtype, device=like.device)[None]
    check_symmetries(symmetries)
    if symmetries.shape[1] == 3:
        symmetries = transform(symmetries, torch.zeros_like(symmetries[:, 0]))
    return symmetries.to(like)


def _chunks(transforms: Tensor, points: Tensor) -> tuple[Tensor, ...]:
    """Split (N, ...) so that at most ``_CHUNK`` points are transformed at once; at least one
    chunk."""
    return torch.split(transforms, max(1, _CHUNK // len(points)))


def _transform(T: Tensor, points: Tensor) -> Tensor:
    """(N, 3 or 4, 4) and (P, 3) -> (N, 3, P)."""
    return T[:, :3, :3] @ points.T + T[:, :3, 3:]


def _project(projections: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 3, 4) projections -> pixels (N, 2, P), and which points (N, P) are in front of the
    camera."""
    image = _transform(projections, points)
    front = image[:, 2:] > 0
    return image[:, :2] / image[:, 2:].where(front, 1.0), front[:, 0]


def median_error(errors: Tensor) -> float:
    """Median of the errors (N,) (MedErr): the mean of the middle two for an even number, NaN for N
    = 0.

    Example:
        >>> median_error(torch.tensor([40.0, 5.0, 12.0, 170.0]))
        26.0
    """
    _check_errors(errors)
    return median(errors.tolist()) if len(errors) else math.nan


@full_precision()
def symmetric_rotation_error(R_est: Tensor, R_gt: Tensor, symmetries: Tensor) -> Tensor:
    """Rotation error of an object with discrete symmetries: ``min_S angle(R_est, R_gt S)``.

    Args:
        R_est, R_gt: (..., 3, 3), broadcast against each other; NaN in ``R_est`` for a missing
            estimate.
        symmetries: (S, 3, 3) rotations of the model onto itself, S >= 0: the whole group, since
            products are not formed. The identity is always included.

    Returns:
        (...) degrees in [0, 180]; ``inf`` for a missing estimate.

    Example:
        >>> half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
        >>> float(symmetric_rotation_error(half_turn, torch.eye(3), half_turn[None]))
        0.0
    """
    for name, R in (("R_est", R_est), ("R_gt", R_gt), ("symmetries", symmetries)):
        check_rotation(R, name)
    check_finite(R_gt, "R_gt")
    check_finite(symmetries, "symmetries")
    valid = R_est.isfinite().flatten(-2).all(-1)
    plain = rotation_error(R_est, R_gt)
    symmetric = rotation_error(R_est.unsqueeze(-3), R_gt.unsqueeze(-3) @ symmetries.to(R_gt.dtype))
    return torch.cat([plain.unsqueeze(-1), symmetric], -1).amin(-1).where(valid, torch.inf)


def _check_errors(errors: Tensor) -> None:
    check_tensor(errors, "errors", (None,))
    if bad := int((~(errors >= 0)).sum()):
        raise InvalidInputError(
            f"errors: expected numbers >= 0, got {bad} that are negative or NaN; a missing "
            f"estimate counts as inf"
        )
