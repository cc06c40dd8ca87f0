"""Rotation errors of symmetric objects, and the averages that PASCAL3D+ tables report.

:func:`curvireg_torch.geometry.rotation_error` computes the plain angle. Rotations map model points into the camera, so
a symmetry ``S`` of the model multiplies from the right: ``R`` and ``R S`` show the same image. An estimate with NaN or
inf is missing: its error is ``inf`` and its azimuth is in no bin.

The evaluation code of RenderForCNN computes ``norm(logm(R1' R2)) / sqrt(2)`` with the spectral norm, although only the
Frobenius norm gives the angle. Its errors, and those of later papers, are too small by sqrt(2). ``legacy_sqrt2=True``
reproduces them for comparison; report them only beside the correct numbers.
"""

import math

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry import rotation_error
from ..utils.checks import (
    check_finite,
    check_last_axes,
    check_option,
    check_positive,
    check_rotation,
    check_same_device,
    check_tensor,
)
from .checks import check_errors, fraction_true, inf_unless

AVP_BINS = (4, 8, 16, 24)
"""Numbers of azimuth bins in PASCAL3D+ tables."""


def accuracy(errors: Tensor, threshold_deg: float, *, legacy_sqrt2: bool = False) -> float:
    """Fraction of the errors below a threshold: Acc(pi/6) with 30, Acc(pi/18) with 10; NaN for N = 0.

    Args:
        errors: (N,) degrees >= 0; ``inf`` for an object without an estimate (a miss).
        threshold_deg: degrees > 0.
        legacy_sqrt2: divide the errors by sqrt(2) first, as flawed evaluation code does (see module).

    Example:
        >>> errors = torch.tensor([5.0, 12.0, 40.0, 170.0])
        >>> accuracy(errors, 30.0), accuracy(errors, 30.0, legacy_sqrt2=True)
        (0.5, 0.75)
    """
    check_errors(errors)
    check_positive(threshold_deg, "threshold_deg")
    return fraction_true((errors / math.sqrt(2.0) if legacy_sqrt2 else errors) < threshold_deg)


def median_error(errors: Tensor, *, legacy_sqrt2: bool = False) -> float:
    """Median of the errors (MedErr); the mean of the middle two for an even number, NaN for N = 0.

    Args:
        errors, legacy_sqrt2: as in :func:`accuracy`; the median is ``inf`` if half of the errors are.

    Example:
        >>> median_error(torch.tensor([40.0, 5.0, 12.0, 170.0]))
        26.0
    """
    check_errors(errors)
    if errors.numel() == 0:
        return math.nan
    ordered = errors.double().sort().values
    median = float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2.0
    return median / math.sqrt(2.0) if legacy_sqrt2 else median


def symmetric_rotation_error(R_est: Tensor, R_gt: Tensor, symmetries: Tensor) -> Tensor:
    """Rotation error of an object with discrete symmetries: ``min_S angle(R_est, R_gt S)``.

    Args:
        R_est, R_gt: (..., 3, 3), broadcast against each other; NaN in ``R_est`` for a missing estimate.
        symmetries: (S, 3, 3) rotations of the model onto itself, S >= 0: the whole group, since products are not
            formed. The identity is always included.

    Returns:
        (...) degrees in [0, 180]; ``inf`` for a missing estimate.

    Example:
        >>> half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
        >>> float(symmetric_rotation_error(half_turn, torch.eye(3), half_turn[None]))
        0.0
    """
    valid = _check_rotations(R_est, R_gt)
    check_tensor(symmetries, "symmetries", (None, 3, 3))
    check_same_device(symmetries, R_gt, "symmetries")
    check_finite(symmetries, "symmetries")
    check_rotation(symmetries, "symmetries")
    plain = rotation_error(R_est, R_gt)
    symmetric = rotation_error(R_est.unsqueeze(-3), R_gt.unsqueeze(-3) @ symmetries.to(R_gt.dtype))
    return inf_unless(valid, torch.cat([plain.unsqueeze(-1), symmetric], -1).amin(-1))


def axis_rotation_error(R_est: Tensor, R_gt: Tensor, axis: Tensor) -> Tensor:
    """Rotation error of a solid of revolution: ``min_phi angle(R_est, R_gt Rot(axis, phi))``.

    The minimum is the angle between ``R_est axis`` and ``R_gt axis``, computed from the chord, since ``acos`` loses
    digits near 0.

    Args:
        R_est, R_gt: as in :func:`symmetric_rotation_error`, as is the result.
        axis: (3,) direction of the axis in the model frame, of any length > 0. Its two ends differ; for a solid that
            looks the same upside down, take the minimum with the flipped rotation too.

    Example:
        >>> from curvireg_torch.geometry import rotation_from_viewpoint
        >>> a, b = rotation_from_viewpoint(0.0, 10.0), rotation_from_viewpoint(120.0, 30.0)
        >>> round(float(axis_rotation_error(a, b, torch.tensor([0.0, 0.0, 1.0]))), 3)   # the azimuth of a vase is free
        20.0
    """
    valid = _check_rotations(R_est, R_gt)
    check_tensor(axis, "axis", (3,))
    check_same_device(axis, R_gt, "axis")
    length = torch.linalg.vector_norm(axis)
    if not bool(length > 0) or not bool(length.isfinite()):
        raise InvalidInputError(f"axis: expected a direction of finite length > 0, got {axis.tolist()}")
    axis = (axis / length).to(R_gt.dtype)
    half_chord = torch.linalg.vector_norm(R_est @ axis - R_gt @ axis, dim=-1) / 2.0
    return inf_unless(valid, torch.rad2deg(2.0 * torch.asin(half_chord.clamp(max=1.0))))


def _check_rotations(R_est: Tensor, R_gt: Tensor) -> Tensor:
    """Which estimates are not missing, (...) bool."""
    for name, R in (("R_est", R_est), ("R_gt", R_gt)):
        check_last_axes(R, name, (3, 3))
    check_same_device(R_est, R_gt, "R_est")
    check_rotation(R_gt, "R_gt")
    check_rotation(R_est, "R_est")
    check_finite(R_gt, "R_gt")
    return R_est.isfinite().flatten(-2).all(-1)


def azimuth_bin(azimuth: Tensor, bins: int) -> Tensor:
    """Azimuth bin of PASCAL3D+, int64 in [0, bins); bin i is [(i - 1/2) 360/bins, (i + 1/2) 360/bins).

    Args:
        azimuth: (...) degrees, not restricted to [0, 360).
        bins: 4, 8, 16 or 24.

    Example:
        >>> azimuth_bin(torch.tensor([0.0, 44.0, 45.0, 350.0]), 4).tolist()
        [0, 0, 1, 0]
    """
    check_option(str(bins), tuple(map(str, AVP_BINS)), "bins")
    check_last_axes(azimuth, "azimuth", ())
    check_finite(azimuth, "azimuth")
    return torch.floor(azimuth % 360.0 * (bins / 360.0) + 0.5).long() % bins


def binned_accuracy(azimuth_est: Tensor, azimuth_gt: Tensor, bins: int) -> float:
    """Fraction of the objects whose azimuth is in the correct bin: AVP with ground-truth boxes; NaN for N = 0.

    Args:
        azimuth_est, azimuth_gt: (N,) degrees; NaN or inf in ``azimuth_est`` for a missing estimate.
        bins: 4, 8, 16 or 24.

    Example:
        >>> binned_accuracy(torch.tensor([3.0, 100.0]), torch.tensor([350.0, 130.0]), 8)
        0.5
    """
    check_tensor(azimuth_gt, "azimuth_gt", (None,))
    check_tensor(azimuth_est, "azimuth_est", tuple(azimuth_gt.shape))
    valid = azimuth_est.isfinite()
    same = azimuth_bin(azimuth_est.where(valid, 0.0), bins) == azimuth_bin(azimuth_gt, bins)
    return fraction_true(valid & same)
