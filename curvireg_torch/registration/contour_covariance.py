"""How well contours fix a pose: the covariance of :func:`fit_contours`."""

import math

import torch
from torch import Tensor

from .calibration import COVARIANCE_SCALE
from .contour_descent import Matches, cross, project
from .contour_points import ContourPoints

__all__ = ["pose_covariance"]

CELL, CELLS = 32.0, 16
"""Side in px of the squares within which all contour points err together, and how many of them are told apart."""

NORMAL, SIGHT = 0.05, 0.05
"""Errors of rendered contour points: of the normals in rad, and along the line of sight in object radii (at a rim depth
changes within a pixel)."""

POINT, SHARED = 0.6, 6.0
"""Variance of every point's distance: (0.6 px)^2 and six times what the residuals have, for what they share."""

OBSERVABLE = 0.75
"""A direction is known if this share of its information is more than such errors make."""

UNKNOWN = math.pi
"""Standard deviation in rad of turns that the contours do not fix; of shifts that they do not fix, the distance."""


def pose_covariance(
    found: Matches, points: ContourPoints, T: Tensor, K: Tensor, centre: Tensor, *, radius: float
) -> tuple[Tensor, Tensor]:
    """Covariance of poses by least squares over contour points, and how many directions they fix.

    With J the derivatives, W the weights, A = J^T W J and r the residuals, the covariance is
    ``COVARIANCE_SCALE`` A^-1 B A^-1 with

        B = sum_c g_c g_c^T + (0.36 px^2 + 6 s^2) J^T W^2 J,

    g_c being the sum of r_i w_i J_i over a square of 32 px, whose points err together, and s^2 the mean of r_i^2.

    Errors make information too: normals off by 0.05 rad and points off by 0.05 radii along the line of sight give E
    where there is none. Directions x with x^T A x < 0.75 x^T (A + E) x count as unknown: a sphere's turns, a
    cylinder's about its axis. They get a standard deviation of pi (turns) or of the distance (shifts).

    Args:
        found: edges beside the points.
        points: of N poses.
        T: (N, 4, 4).
        K: (N, 3, 3) of the crops.
        centre, radius: of the object, (3,) and model units.

    Returns:
        (N, 6, 6) of (turn, translation of the model's origin), NaN where too few edges were found; (N,) directions
        known, 0 to 6.
    """
    uv, du = project(points.model, T, K, centre)
    n, W = points.normals, found.weight
    along = (torch.stack([-n[..., 1], n[..., 0]], dim=-1)[..., None, :] @ du)[..., 0, :]
    cam = (points.model - centre) @ T[:, :3, :3].mT + (T[:, :3, :3] @ centre + T[:, :3, 3])[:, None]
    ray = cam / torch.linalg.vector_norm(cam, dim=-1, keepdim=True).clamp(min=1e-12)
    sight = torch.zeros_like(along)
    sight[..., :3] = torch.linalg.cross(ray, found.J[..., 3:])
    A = found.J.mT @ (W * found.J)
    E = NORMAL**2 * along.mT @ (W * along) + (SIGHT * radius) ** 2 * sight.mT @ (W * sight)
    # Basis of directions in which A + E is 1 and A diagonal; units first.
    unit = (A + E).diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    both = unit[:, :, None] * (A + E) * unit[:, None] + 1e-9 * torch.eye(6, dtype=A.dtype)
    lower = torch.linalg.cholesky(both)
    half = torch.linalg.solve_triangular(lower, unit[:, :, None] * A * unit[:, None], upper=False)
    share, turned = torch.linalg.eigh(torch.linalg.solve_triangular(lower, half.mT, upper=False))
    basis = unit[:, :, None] * torch.linalg.solve_triangular(lower.mT, turned, upper=True)
    known = share > OBSERVABLE

    cell = ((uv / CELL).floor().long().clamp(0, CELLS - 1) * torch.tensor([1, CELLS])).sum(dim=-1)
    g = torch.zeros(len(T), CELLS**2, 6, dtype=A.dtype)
    g.scatter_add_(1, cell[..., None].expand(-1, -1, 6), W * found.distance * found.J)
    square = (W * found.distance**2).sum(dim=1, keepdim=True) / W.sum(dim=1, keepdim=True).clamp(min=1e-12)
    B = g.mT @ g + (POINT**2 + SHARED * square) * (found.J.mT @ (W * W * found.J))
    inverse = basis * (known / share.clamp(min=1e-12))[:, None]
    C = COVARIANCE_SCALE * inverse @ (basis.mT @ B @ basis) @ inverse.mT
    position = T[:, :3, :3] @ centre + T[:, :3, 3]
    turn, shift = (torch.linalg.vector_norm(part, dim=1).clamp(min=1e-300) for part in basis.split(3, dim=1))
    distance = torch.linalg.vector_norm(position, dim=1)[:, None]
    size = torch.minimum(UNKNOWN / turn, distance / shift)
    unknown = basis * (~known * size)[:, None]
    C = C + unknown @ unknown.mT
    # The origin moves by e - w x arm where the centre moves by e.
    lever = torch.eye(6, dtype=C.dtype).repeat(len(C), 1, 1)
    lever[:, 3:, :3] = cross(T[:, :3, :3] @ centre)
    C = lever @ C @ lever.mT
    enough = W.sum(dim=(1, 2)) > 6.0
    return torch.where(enough[:, None, None], 0.5 * (C + C.mT), torch.nan), known.sum(dim=1) * enough
