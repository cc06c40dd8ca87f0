"""Errors of 6D poses (ADD, ADD-S, MSSD, MSPD) and the recalls of BOP.

All errors take the estimated and the true pose ``T_cam_from_model`` and points on the surface of the model in one unit.
A missing estimate is a pose of NaN; any other pose that is not rigid is refused.

- ADD (Hinterstoisser et al. 2012): mean over the points x of ``|T_est x - T_gt x|``;
- ADD-S: mean over x of the distance of ``T_gt x`` to the nearest ``T_est y``;
- MSSD, MSPD (Hodan et al. 2020): minimum over the symmetries S of the maximum over x of ``|T_est x - T_gt S x|``, in
  space or after projection into the image.
"""

from collections.abc import Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import (
    check_camera_matrix,
    check_finite,
    check_pose,
    check_positive,
    check_same_device,
    check_tensor,
)
from .checks import check_errors, fraction_true, inf_unless, per_item

_CHUNK = 1 << 22
"""Points transformed at once: 50 MB of float32 coordinates."""

_MSSD_THRESHOLDS = tuple(step / 20.0 for step in range(1, 11))
_MSPD_THRESHOLDS = tuple(5.0 * step for step in range(1, 11))


def add_error(T_est: Tensor, T_gt: Tensor, points: Tensor) -> Tensor:
    """ADD: mean distance of the points under the two poses.

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
    return inf_unless(valid, torch.cat(means))


def adds_error(T_est: Tensor, T_gt: Tensor, points: Tensor) -> Tensor:
    """ADD-S: mean distance of each point under the true pose to the nearest point under the estimate.

    Computed in float64 on the CPU with one k-d tree in the model frame, since rigid poses preserve distances.

    Arguments and result are those of :func:`add_error`.

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
    return inf_unless(valid, torch.tensor(means, dtype=T_est.dtype, device=T_est.device))


def mssd_error(T_est: Tensor, T_gt: Tensor, points: Tensor, *, symmetries: Tensor | None = None) -> Tensor:
    """MSSD: maximum distance of the model points in space, minimum over the symmetries of the object.

    Args:
        T_est, T_gt, points: as in :func:`add_error`.
        symmetries: (S, 4, 4) of the model, S >= 1, including the identity, for example from
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
    largest = [_transform(d, points).norm(dim=1).amax(1) for d in _chunks(difference.flatten(0, 1), points)]
    return inf_unless(valid, torch.cat(largest).view(difference.shape[:2]).amin(1))


def mspd_error(
    T_est: Tensor, T_gt: Tensor, points: Tensor, camera_matrix: Tensor, *, symmetries: Tensor | None = None
) -> Tensor:
    """MSPD: maximum distance of the model points in the image, minimum over the symmetries of the object.

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
    check_same_device(camera_matrix, T_est, "camera_matrix")
    check_camera_matrix(camera_matrix)
    K = camera_matrix.to(T_est.dtype)
    if K.ndim == 3:
        K = K.unsqueeze(1)
    true = K @ (T_gt.unsqueeze(1) @ _checked_symmetries(symmetries, T_gt))[:, :, :3]
    estimated = (K @ T_est.unsqueeze(1)[:, :, :3]).expand_as(true)
    largest = []
    for a, b in zip(*(_chunks(projections.flatten(0, 1), points) for projections in (estimated, true)), strict=True):
        (xy_a, front_a), (xy_b, front_b) = _project(a, points), _project(b, points)
        largest.append(inf_unless(front_a & front_b, (xy_a - xy_b).norm(dim=1)).amax(1))
    return inf_unless(valid, torch.cat(largest).view(true.shape[:2]).amin(1))


def add_recall(errors: Tensor, diameter: Tensor | float, *, fraction: float = 0.1) -> float:
    """Fraction of the poses with ADD (or ADD-S) below a fraction of the object diameter; NaN for N = 0.

    Args:
        errors: (N,) >= 0 from :func:`add_error` or :func:`adds_error`.
        diameter: of the objects, a number or (N,) > 0, in the unit of the errors.
        fraction: of the diameter, > 0.

    Example:
        >>> add_recall(torch.tensor([1.0, 9.0, 11.0, torch.inf]), 100.0)
        0.5
    """
    check_positive(fraction, "fraction")
    check_errors(errors)
    return _average_recall(errors / per_item(diameter, errors, "diameter"), (fraction,))


def mssd_recall(errors: Tensor, diameter: Tensor | float) -> float:
    """AR_MSSD of BOP: fraction of the poses with MSSD below 0.05, 0.10, ..., 0.50 diameters, averaged.

    ``diameter`` is that of :func:`add_recall`, ``errors`` come from :func:`mssd_error`.

    Example:
        >>> mssd_recall(torch.tensor([26.0]), 100.0)      # below 0.30, 0.35, 0.40, 0.45 and 0.50
        0.5
    """
    check_errors(errors)
    return _average_recall(errors / per_item(diameter, errors, "diameter"), _MSSD_THRESHOLDS)


def mspd_recall(errors: Tensor, image_width: Tensor | float) -> float:
    """AR_MSPD of BOP: fraction of the poses with MSPD below 5, 10, ..., 50 px times image width / 640, averaged.

    ``image_width`` in px is a number or (N,) > 0, ``errors`` come from :func:`mspd_error`.

    Example:
        >>> mspd_recall(torch.tensor([26.0]), 640), mspd_recall(torch.tensor([26.0]), 1280)
        (0.5, 0.8)
    """
    check_errors(errors)
    return _average_recall(errors * 640.0 / per_item(image_width, errors, "image_width"), _MSPD_THRESHOLDS)


def _average_recall(errors: Tensor, thresholds: Sequence[float]) -> float:
    return sum(fraction_true(errors < threshold) for threshold in thresholds) / len(thresholds)


def _checked(T_est: Tensor, T_gt: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """In the dtype of ``T_est``, missing estimates replaced by the truth; and a mask of valid estimates."""
    check_tensor(T_est, "T_est", (None, 4, 4))
    check_tensor(T_gt, "T_gt", (len(T_est), 4, 4))
    check_tensor(points, "points", (None, 3))
    check_same_device(T_gt, T_est, "T_gt")
    check_same_device(points, T_est, "points")
    if len(points) == 0:
        raise InvalidInputError("points: expected at least one point, got none")
    check_finite(points, "points")
    check_pose(T_gt, "T_gt")
    T_gt = T_gt.to(T_est.dtype)
    valid = T_est.isfinite().flatten(1).all(1)
    T_est = torch.where(valid.view(-1, 1, 1), T_est, T_gt)
    check_pose(T_est, "T_est")
    return T_est, T_gt, points.to(T_est.dtype), valid


def _checked_symmetries(symmetries: Tensor | None, like: Tensor) -> Tensor:
    if symmetries is None:
        return torch.eye(4, dtype=like.dtype, device=like.device).unsqueeze(0)
    check_tensor(symmetries, "symmetries", (None, 4, 4))
    if len(symmetries) == 0:
        raise InvalidInputError("symmetries: expected at least the identity, got none")
    check_pose(symmetries, "symmetries")
    return symmetries.to(like)


def _chunks(transforms: Tensor, points: Tensor) -> list[Tensor]:
    """Split (N, ...) so that at most ``_CHUNK`` points are transformed at once; at least one chunk."""
    step = max(1, _CHUNK // len(points))
    return [transforms[start : start + step] for start in range(0, max(1, len(transforms)), step)]


def _transform(T: Tensor, points: Tensor) -> Tensor:
    """(N, 3 or 4, 4) and (P, 3) -> (N, 3, P)."""
    return T[:, :3, :3] @ points.T + T[:, :3, 3:]


def _project(projections: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 3, 4) projections -> pixels (N, 2, P), and which points (N, P) are in front of the camera."""
    image = _transform(projections, points)
    front = image[:, 2] > 0
    return image[:, :2] / torch.where(front, image[:, 2], torch.ones_like(image[:, 2])).unsqueeze(1), front
