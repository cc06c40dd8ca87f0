"""How well contours determine a pose: the covariance of :func:`fit_contours`."""

import math

import torch
from torch import Tensor

from ...geometry.conversions import cross_matrix
from ...rendering.contours import ContourPoints
from ..calibration import COVARIANCE_SCALE
from .descent import Matches, project

__all__ = ["pose_covariance"]

CELL, CELLS = 32.0, 16
"""Side in px of the square cells within which errors of contour points are correlated, and cells per side."""

NORMAL, SIGHT = 0.05, 0.05
"""Errors of rendered contour points: of the normals in rad, and along the line of sight in object radii (at an
occluding contour, depth varies within a pixel)."""

POINT, SHARED = 0.6, 6.0
"""Variance of each distance: (0.6 px)^2, plus six times the mean squared residual for what points have in common."""

OBSERVABLE = 0.75
"""A direction counts as known if this fraction of its information does not come from such errors."""

UNKNOWN = math.pi
"""Standard deviation in rad of an unknown rotation; that of an unknown translation is the distance."""


def pose_covariance(
    matches: Matches, points: ContourPoints, T: Tensor, K: Tensor, centre: Tensor, *, radius: float
) -> tuple[Tensor, Tensor]:
    """Covariance of poses by least squares over contour points, and the number of directions that they determine.

    With J the derivatives, W the weights, A = J^T W J and r the residuals, the covariance is
    ``COVARIANCE_SCALE`` A^-1 B A^-1 with

        B = sum_c g_c g_c^T + (0.36 px^2 + 6 s^2) J^T W^2 J,

    where g_c is the sum of r_i w_i J_i over a cell of 32 px, whose points have correlated errors, and s^2 the mean of
    r_i^2.

    Errors produce information as well: normals that are off by 0.05 rad and points that are off by 0.05 radii along
    the line of sight produce E. Directions x with x^T A x < 0.75 x^T (A + E) x count as unknown: the rotations of a
    sphere, or that of a cylinder about its axis. Their standard deviation is pi (rotation) or the distance.

    Args:
        matches: edges near the contour ``points`` of N poses.
        T, K: (N, 4, 4) and (N, 3, 3) of the crops.
        centre, radius: of the object, (3,) and model units.

    Returns:
        (N, 6, 6) of (rotation, translation of the model's origin), NaN where too few edges were matched; (N,) number
        of known directions, 0 to 6.
    """
    uv, du = project(points.model, T, K, centre)
    n, W = points.normals, matches.weight
    along = (torch.stack([-n[..., 1], n[..., 0]], dim=-1)[..., None, :] @ du)[..., 0, :]
    cam = (points.model - centre) @ T[:, :3, :3].mT + (T[:, :3, :3] @ centre + T[:, :3, 3])[:, None]
    ray = cam / torch.linalg.vector_norm(cam, dim=-1, keepdim=True).clamp(min=1e-12)
    sight = torch.zeros_like(along)
    sight[..., :3] = torch.linalg.cross(ray, matches.J[..., 3:])
    A = matches.J.mT @ (W * matches.J)
    E = NORMAL**2 * along.mT @ (W * along) + (SIGHT * radius) ** 2 * sight.mT @ (W * sight)
    # Basis of directions in which A + E is the identity and A is diagonal; first normalise the units.
    unit = (A + E).diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    total = unit[:, :, None] * (A + E) * unit[:, None] + 1e-9 * torch.eye(6, dtype=A.dtype)
    lower = torch.linalg.cholesky(total)
    half = torch.linalg.solve_triangular(lower, unit[:, :, None] * A * unit[:, None], upper=False)
    fraction, vectors = torch.linalg.eigh(torch.linalg.solve_triangular(lower, half.mT, upper=False))
    basis = unit[:, :, None] * torch.linalg.solve_triangular(lower.mT, vectors, upper=True)
    known = fraction > OBSERVABLE

    cell = ((uv / CELL).floor().long().clamp(0, CELLS - 1) * torch.tensor([1, CELLS])).sum(dim=-1)
    g = torch.zeros(len(T), CELLS**2, 6, dtype=A.dtype)
    g.scatter_add_(1, cell[..., None].expand(-1, -1, 6), W * matches.distance * matches.J)
    square = (W * matches.distance**2).sum(dim=1, keepdim=True) / W.sum(dim=1, keepdim=True).clamp(min=1e-12)
    B = g.mT @ g + (POINT**2 + SHARED * square) * (matches.J.mT @ (W * W * matches.J))
    inverse = basis * (known / fraction.clamp(min=1e-12))[:, None]
    C = COVARIANCE_SCALE * inverse @ (basis.mT @ B @ basis) @ inverse.mT
    position = T[:, :3, :3] @ centre + T[:, :3, 3]
    rotation, translation = (torch.linalg.vector_norm(part, dim=1).clamp(min=1e-300) for part in basis.split(3, dim=1))
    distance = torch.linalg.vector_norm(position, dim=1)[:, None]
    size = torch.minimum(UNKNOWN / rotation, distance / translation)
    unknown = basis * (~known * size)[:, None]
    C = C + unknown @ unknown.mT
    # From the translation e of the centre to that of the origin, e - w x (R centre).
    lever = torch.eye(6, dtype=C.dtype).repeat(len(C), 1, 1)
    lever[:, 3:, :3] = cross_matrix(T[:, :3, :3] @ centre)
    C = lever @ C @ lever.mT
    enough = W.sum(dim=(1, 2)) > 6.0
    return torch.where(enough[:, None, None], 0.5 * (C + C.mT), torch.nan), known.sum(dim=1) * enough
