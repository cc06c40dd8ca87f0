"""Robust least squares over rigid poses: projection, its derivative, and the measurements that pull
on a pose."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from ..calibration import COVARIANCE_SCALE
from ..geometry import rotation_from_axis_angle
from ..geometry.cameras import point_in_cameras, pose_around, transform
from ..geometry.conversions import cross_matrix
from ..rendering.contours import ContourPoints
from ..utils.rows import Rows

# Longest step: radians, and fraction of the object's distance
MAX_ROTATION = 0.2
MAX_TRANSLATION = 0.1
INLIER_SCALE = 2.0  # Distance in px at which a point match counts a quarter
MIN_MATCHES = 8  # Point matches that a pose needs
# Levenberg-Marquardt damping of a fit to points alone, a fraction of the diagonal of J^T W J
POINT_DAMPING = 1e-5
# Added to a diagonal that may be 0; it must not count beside that of a translation in small units
LEAST_INFORMATION = 1e-200


@dataclass(frozen=True)
class Measurements(Rows):
    """What N poses are fitted to: derivatives ``J`` (N, P, 6) of distances in px by rotation about
    the object's centre (rad) and translation, these distances and their weights, (N, P, 1)."""

    J: Tensor
    distance: Tensor
    weight: Tensor

    def equations(self) -> tuple[Tensor, Tensor]:
        """Normal equations J^T W J (N, 6, 6) and J^T W d (N, 6, 1)."""
        unknowns = self.J.shape[-1]
        # A CPU rounds products of an odd size by their place in the batch.
        J = F.pad(self.J, (0, 1)) if unknowns % 2 else self.J
        WJ = (self.weight * J).mT
        A = torch.bmm(WJ, J)[:, :unknowns, :unknowns]
        return A, torch.bmm(WJ, self.distance)[:, :unknowns]


@dataclass(frozen=True)
class PointMatches(Rows):
    """Points of a mesh ``model`` (1, C, 3) that were found at ``uv`` (1, C, 2) px with ``weight``
    (1, C) in [0, 1]; 0 marks a point that was not found."""

    model: Tensor
    uv: Tensor
    weight: Tensor

    def measurements(self, T: Tensor, K: Tensor, centre: Tensor, scale: float) -> Measurements:
        """Two for each point, along x and y, with Geman-McClure weights of ``scale`` px."""
        uv, J = project(self.points.model, self.points.normals, T, K, centre)
        residual = self.uv - uv[:, ::2]
        weight = self.weight * _geman_mcclure(residual, scale)
        weights = weight[..., None].expand_as(residual)
        return Measurements(J, residual.flatten(1)[..., None], weights.flatten(1)[..., None])

    @cached_property
    def points(self) -> ContourPoints:
        """Each point twice (1, 2 C), with normals along the x axis of the image and along its y
        axis."""
        model = self.model.repeat_interleave(2, dim=1)
        axes = torch.eye(2, dtype=model.dtype).repeat(self.model.shape[1], 1)[None]
        seen = torch.ones(model.shape[:2], dtype=torch.bool)
        return ContourPoints(model, axes, seen, ~seen)

    def inlier_ratio(self, T: Tensor, K: Tensor, *, scale: float = INLIER_SCALE) -> float:
        """Mean weight, in [0, 1], of the points that were found where the pose has them: a quarter
        of it counts at ``scale`` px."""
        near = _geman_mcclure(self.uv - pixels(self.model, T, K), scale)
        return float((near * self.weight).sum()) / max(self.weight.shape[1], 1)

    def scaled(self, factor: float) -> "PointMatches":
        """The same with weights times ``factor``."""
        return PointMatches(self.model, self.uv, factor * self.weight)

    def moved(self, before: Tensor, after: Tensor) -> "PointMatches":
        """The same in another crop of the photograph: ``before`` and ``after`` are the crops'
        cameras (1, 3, 3)."""
        A = (after @ torch.linalg.inv(before))[0]
        return PointMatches(self.model, self.uv @ A[:2, :2].mT + A[:2, 2], self.weight)


def _geman_mcclure(residual: Tensor, scale: float) -> Tensor:
    """(N, C) weights in (0, 1] of residuals (N, C, 2) px."""
    return (1.0 + residual.square().sum(dim=-1) / scale**2) ** -2


def fit_points(
    matches: PointMatches, T: Tensor, K: Tensor, centre: Tensor, scales: Sequence[float]
) -> Tensor:
    """(1, 4, 4) pose that most matches agree on, by robust least squares from ``T`` (1, 4, 4);
    ``T`` if there are few. ``scales`` of the robust weights in px are one a step: at first all
    matches count, in the end those that agree."""
    if int((matches.weight > 0).sum()) < MIN_MATCHES:
        return T
    for scale in scales:
        A, b = matches.measurements(T, K, centre, scale).equations()
        T = apply_twist(T, least_squares_step(A, b, T, centre, POINT_DAMPING), centre)
    return T


def least_squares_step(A: Tensor, b: Tensor, T: Tensor, centre: Tensor, damping: float) -> Tensor:
    """(N, 6) Levenberg-Marquardt steps of poses ``T`` (N, 4, 4) from normal equations, of bounded
    length."""
    step = damped_solution(A, b, damping)
    return step * step_fraction(step, T, centre)[:, None]


def step_fraction(step: Tensor, T: Tensor, centre: Tensor) -> Tensor:
    """(N,) in [0, 1]: the part of steps (N, 6) of poses that is not too long."""
    z = point_in_cameras(T, centre)[:, 2].clamp(min=0.0)
    lengths = torch.linalg.vector_norm(step.unflatten(1, (2, 3)), dim=2).clamp(min=1e-12)
    rotation, translation = lengths.unbind(1)
    longest = torch.minimum(MAX_ROTATION / rotation, MAX_TRANSLATION * z / translation)
    return longest.clamp(max=1.0)


def damped_solution(A: Tensor, b: Tensor, damping: float) -> Tensor:
    """(N, 6) solutions of (A + damping diag A) x = b, for (N, 6, 6) and (N, 6, 1); 0 without
    measurements."""
    damped = A.clone()
    diagonal = damped.diagonal(dim1=-2, dim2=-1)
    diagonal += damping * diagonal + LEAST_INFORMATION
    # without the check, which takes as long
    solution: Tensor = torch.linalg.solve_ex(damped, b).result[..., 0]
    return solution


def project(
    points: Tensor, normals: Tensor, T: Tensor, K: Tensor, centre: Tensor
) -> tuple[Tensor, Tensor]:
    """Pixels (N, P, 2) of model points, and the derivative (N, P, 6) of their shift along unit
    vectors ``normals`` (N, P, 2) by rotation about and translation of the centre."""
    R = T[:, :3, :3]
    arms = (points - centre) @ R.mT
    cam = arms + point_in_cameras(T, centre)[:, None]
    z = cam[..., 2:].clamp(min=1e-9)
    uv = cam @ K[:, :2].mT / z
    by_cam = (normals @ K[:, :2] - (normals * uv).sum(dim=-1, keepdim=True) * K[:, None, 2]) / z
    by_rotation = torch.linalg.cross(arms, by_cam)  # b . (w x a) = w . (a x b)
    return uv, torch.cat([by_rotation, by_cam], dim=-1)


def pixels(points: Tensor, T: Tensor, K: Tensor) -> Tensor:
    """The pixels of :func:`project` without their derivative."""
    cam = torch.baddbmm(T[:, None, :3, 3], points.expand(len(T), -1, -1), T[:, :3, :3].mT)
    return cam @ K[:, :2].mT / cam[..., 2:].clamp(min=1e-9)


def apply_twist(T: Tensor, step: Tensor, centre: Tensor) -> Tensor:
    """(N, 4, 4) poses, rotated by ``step[:, :3]`` rad about the centre, which is then translated by
    ``step[:, 3:]``."""
    R = rotation_from_axis_angle(step[:, :3]) @ T[:, :3, :3]
    return pose_around(R, point_in_cameras(T, centre) + step[:, 3:], centre)


def shifts(J: Tensor, change: Tensor) -> Tensor:
    """(N, P, 1) the products of derivatives (N, P, D) and changes (N, D)."""
    # J @ change is rounded otherwise for N = 1.
    return torch.bmm(change[:, None], J.mT).mT


def nearest_rigid(T: Tensor) -> Tensor:
    """The poses (N, 4, 4) with the nearest rotations: products of many rotations lose their
    orthogonality."""
    U, _, V = torch.linalg.svd(T[:, :3, :3])
    return transform(U @ V, T[:, :3, 3])


# Side in px of the square cells within which errors of contour points are correlated, and cells per
# side
CELL_SIDE = 32.0
CELLS_PER_SIDE = 16
# Errors of contour points: of the normals in rad, and along the line of sight in object radii (at
# an occluding contour the surface turns away)
NORMAL_ERROR = 0.05
SIGHT_ERROR = 0.05
# Variance of each distance: (0.6 px)^2, plus six times the mean squared residual for what points
# have in common
POINT_ERROR = 0.6
SHARED_ERROR = 6.0
# A direction counts as known if this fraction of its information does not come from such errors
OBSERVABLE_FRACTION = 0.75
# Standard deviation in rad of an unknown rotation; that of an unknown translation is the distance
UNKNOWN_ROTATION = math.pi
MIN_TOTAL_WEIGHT = 6.0  # Sum of weights that a covariance needs


def summed_by_cells(uv: Tensor, values: Tensor) -> Tensor:
    """(N, C, D) sums of values (N, P, D) of points (N, P, 2) over the cells of crops within which
    errors are correlated."""
    cell = (uv / CELL_SIDE).floor().long().clamp(0, CELLS_PER_SIDE - 1)
    cell = (cell * torch.tensor([1, CELLS_PER_SIDE], device=cell.device)).sum(dim=-1)
    sums = values.new_zeros(len(values), CELLS_PER_SIDE**2, values.shape[-1])
    return sums.scatter_add_(1, cell[..., None].expand_as(values), values)


def residual_variance(measured: Measurements) -> Tensor:
    """(N,) px^2 of each distance."""
    W = measured.weight
    square = (W * measured.distance**2).sum(dim=(1, 2)) / W.sum(dim=(1, 2)).clamp(min=1e-12)
    return POINT_ERROR**2 + SHARED_ERROR * square


def pose_covariance(
    measured: Measurements,
    points: ContourPoints,
    T: Tensor,
    K: Tensor,
    centre: Tensor,
    *,
    radius: float,
) -> tuple[Tensor, Tensor]:
    """Covariance of poses by least squares over contour points, and the number of directions that
    they determine.

    With J the derivatives, W the weights, A = J^T W J and r the residuals, the covariance is
    ``COVARIANCE_SCALE`` A^-1 B A^-1 with

        B = sum_c g_c g_c^T + (0.36 px^2 + 6 s^2) J^T W^2 J,

    where g_c is the sum of r_i w_i J_i over a cell of 32 px, whose points have correlated errors,
    and s^2 the mean of r_i^2.

    Errors produce information as well: normals that are off by 0.05 rad and points that are off by
    0.05 radii along the line of sight produce E. Directions x with x^T A x < 0.75 x^T (A + E) x
    count as unknown, such as the rotation of a cylinder about its axis. Their standard deviation is
    pi (rotation) or the distance.

    Args:
        measured: edges near the contour ``points`` of N poses ``T`` (N, 4, 4) in crops with cameras
            ``K`` (N, 3, 3).
        centre, radius: of the object, (3,) and model units.

    Returns:
        (N, 6, 6) of (rotation, translation of the model's origin), NaN where too few edges were
        matched; (N,) number of known directions, 0 to 6.
    """
    W = measured.weight
    uv, E = _information_of_errors(measured, points, T, K, centre, radius)
    A = measured.J.mT @ (W * measured.J)
    basis, fraction = _directions(A, A + E)
    known = fraction > OBSERVABLE_FRACTION

    g = summed_by_cells(uv, W * measured.distance * measured.J)
    variance = residual_variance(measured)[:, None, None]
    B = g.mT @ g + variance * (measured.J.mT @ (W * W * measured.J))
    inverse = basis * (known / fraction.clamp(min=1e-12))[:, None]
    C = COVARIANCE_SCALE * inverse @ (basis.mT @ B @ basis) @ inverse.mT
    rotation, translation = (
        torch.linalg.vector_norm(part, dim=1).clamp(min=1e-300) for part in basis.split(3, dim=1)
    )
    distance = torch.linalg.vector_norm(point_in_cameras(T, centre), dim=1)[:, None]
    size = torch.minimum(UNKNOWN_ROTATION / rotation, distance / translation)
    unknown = basis * (~known * size)[:, None]
    C = C + unknown @ unknown.mT
    # From the translation e of the centre to that of the origin, e - w x (R centre).
    lever = torch.eye(6, dtype=C.dtype, device=C.device).repeat(len(C), 1, 1)
    lever[:, 3:, :3] = cross_matrix(T[:, :3, :3] @ centre)
    C = lever @ C @ lever.mT
    C = 0.5 * (C + C.mT)
    enough = W.sum(dim=(1, 2)) > MIN_TOTAL_WEIGHT
    return torch.where(enough[:, None, None], C, torch.nan), known.sum(dim=1) * enough


def _information_of_errors(
    measured: Measurements,
    points: ContourPoints,
    T: Tensor,
    K: Tensor,
    centre: Tensor,
    radius: float,
) -> tuple[Tensor, Tensor]:
    """Pixels (N, P, 2) of contour points, and the information E (N, 6, 6) that errors of their
    normals and of their places along the line of sight produce."""
    n = points.normals
    W = measured.weight
    tangents = torch.stack([-n[..., 1], n[..., 0]], dim=-1)
    uv, along = project(points.model, tangents, T, K, centre)
    cam = (points.model - centre) @ T[:, :3, :3].mT + point_in_cameras(T, centre)[:, None]
    ray = cam / torch.linalg.vector_norm(cam, dim=-1, keepdim=True).clamp(min=1e-12)
    sight = torch.zeros_like(along)
    sight[..., :3] = torch.linalg.cross(ray, measured.J[..., 3:])
    of_normals = NORMAL_ERROR**2 * along.mT @ (W * along)
    of_sight = (SIGHT_ERROR * radius) ** 2 * sight.mT @ (W * sight)
    return uv, of_normals + of_sight


def _directions(A: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """Bases (N, 6, 6) of columns in which ``total`` is the identity and A is diagonal, and this
    diagonal (N, 6): the fraction of the information in each direction."""
    unit = total.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()  # normalises the units
    scale = unit[:, :, None] * unit[:, None]
    identity = torch.eye(6, dtype=A.dtype, device=A.device)
    lower = torch.linalg.cholesky(scale * total + 1e-9 * identity)
    half = torch.linalg.solve_triangular(lower, scale * A, upper=False)
    whitened = torch.linalg.solve_triangular(lower, half.mT, upper=False)
    fraction, vectors = torch.linalg.eigh(whitened)
    basis = unit[:, :, None] * torch.linalg.solve_triangular(lower.mT, vectors, upper=True)
    return basis, fraction
