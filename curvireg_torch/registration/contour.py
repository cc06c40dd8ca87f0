"""Contours of the mesh pulled onto the photograph's edges: the continuous stage of the refinement."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from .._checks import check_positive, check_tensor
from ..errors import InvalidInputError
from ..geometry import crop_images, rotation_from_axis_angle
from ..geometry.cameras import check_camera_matrix, transform
from ..rendering import DepthRenderer
from .contour_points import ContourPoints, EdgeField, contour_points

__all__ = ["ContourFit", "fit_contours"]

SIZE = 256
"""Side of the crop in px; the first rounds use half of it."""

COARSE, FINE = (6.0, 4.0, 3.0, 2.0), (6.0, 4.0, 3.0, 2.0, 2.0)
"""How far edges are looked for in px, round by round; the mesh is rendered anew in each."""

TURN = 8.0
"""Degrees to the left, right, up and down of the given pose from which the fit starts too: half the width of what it
draws in, and about the error of a coarse view."""

FINALISTS = 2
"""Fits that go on at full size."""

STEPS, SELECTIONS = 2, 3
"""Least-squares steps per rendering, and choices of edges per step."""

DAMPING = 1e-2
"""Levenberg-Marquardt: share of its own diagonal that is added to J^T W J."""

CORRELATED = 8.0
"""Neighbouring points err together: so many count as one in the covariance (found on synthetic scenes)."""

MAX_TURN, MAX_SHIFT = 0.2, 0.1
"""Longest step: radians, and share of the object's distance."""


@dataclass(frozen=True)
class ContourFit:
    """N poses fitted to one photograph.

    Attributes:
        transform: (N, 4, 4) float64 ``T_cam_from_model``.
        covariance: (N, 6, 6) float64, see :func:`fit_contours`; NaN where the contours do not fix the pose.
        support: (N,) float64 in [0, 1): mean strength of the edges within about 1 px of the contour points, weighted by
            distance; 0 where the mesh shows no contour in the crop.
    """

    transform: Tensor
    covariance: Tensor
    support: Tensor


@torch.no_grad()
def fit_contours(
    renderer: DepthRenderer,
    image: Tensor,
    box: Tensor,
    camera_matrix: Tensor,
    starts: Tensor,
    *,
    centre: Tensor,
    radius: float,
    margin: float = 0.1,
) -> ContourFit:
    """Poses whose contours lie on a photograph's edges, by robust least squares over SE(3).

    Around each start the mesh is rendered, its occluding contours and creases become 3D points X_i with normals n_i in
    the image (:func:`contour_points`), and the photograph is searched along n_i for edges that run as the contour
    does. With d_i the distance to the chosen edge and J_i = n_i^T du_i/dxi, every step solves

        (J^T W J + lambda diag(J^T W J)) xi = J^T W d,

    W being the edge's strength times Tukey's weight of what remains. Strong edges near where the step leads are chosen
    again within a step; the search narrows from round to round. From each start and from four poses turned away from
    it the fit runs at half size; the best (by support) go on at full size. The start itself is returned where
    nothing has more support than it has.

    The covariance is 8 s^2 (J^T W J)^-1 with the residuals' robust scale s, as if every eighth point were independent.
    Its order is turn (rad) about the camera's
    x, y, z, then translation (model units) along them: with the true pose R, t,

        R = exp([w]x) R_fit,   t = t_fit + e,   (w, e) ~ N(0, covariance).

    It holds for a fit that has found the right edges, and knows nothing of others; turns about an object's axis of
    symmetry look better known than they are, since the normals of rendered contours are not exact. Computed on the CPU.

    Args:
        renderer: of the mesh.
        image: (C, H, W), C = 1 or 3, in [0, 1].
        box: (4,) x0, y0, x1, y1 in px: where to look; need not be exact.
        camera_matrix: (3, 3) in px.
        starts: (N, 4, 4) poses, within about 15 degrees.
        centre, radius: of the object, (3,) and model units.
        margin: room around the box, as a share of its longer side.

    Raises:
        InvalidInputError: wrong shapes, a pose that is not finite, an unusable box or camera matrix.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.rendering import make_renderer
        >>> K = torch.tensor([[200.0, 0, 63.5], [0, 200.0, 63.5], [0, 0, 1]], dtype=torch.float64)
        >>> T = torch.eye(4, dtype=torch.float64); T[2, 3] = 5.0
        >>> T[:3, :3] = rotation_from_axis_angle(torch.tensor([1.0, 0.6, 0.2], dtype=torch.float64))
        >>> renderer = make_renderer(trimesh.creation.box((1, 1.5, 2)))
        >>> image = (renderer.render(T[None], K, (128, 128))[0] > 0).float()
        >>> start = T.clone(); start[0, 3] = 0.1                                              # 2 % to the right
        >>> box = torch.tensor([24.0, 18, 102, 110])
        >>> fit = fit_contours(renderer, image, box, K, start[None], centre=torch.zeros(3), radius=1.4)
        >>> abs(float(fit.transform[0, 0, 3])) < 0.01
        True
    """
    _check(image, box, camera_matrix, starts, radius)
    T0, K, centre = starts.detach().cpu().double(), camera_matrix.detach().cpu().double(), centre.cpu().double()
    crop, A = crop_images([image.detach().cpu().float()], box.detach().cpu().float()[None], size=SIZE, margin=margin)
    full = _Scene(renderer, EdgeField(crop), A[0].double() @ K, SIZE, centre, radius)
    half_K = torch.tensor([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25], [0.0, 0.0, 1.0]], dtype=torch.float64) @ full.K
    half = _Scene(renderer, EdgeField(F.avg_pool2d(crop, 2)), half_K, SIZE // 2, centre, radius)
    N = len(T0)
    if N == 0:
        return ContourFit(T0, T0.new_zeros(0, 6, 6), T0.new_zeros(0))
    turns = torch.zeros(5, 6, dtype=torch.float64)
    turns[1:, :2] = torch.deg2rad(TURN * torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
    around = _moved(T0.repeat_interleave(len(turns), dim=0), turns.repeat(N, 1), centre)
    T = half.descend(around, COARSE)
    best = half.look(T)[1].view(N, -1).topk(FINALISTS, dim=1).indices
    T = T.view(N, -1, 4, 4).gather(1, best[..., None, None].expand(-1, -1, 4, 4)).flatten(0, 1)
    T = torch.cat([T0[:, None], full.descend(T, FINE).view(N, -1, 4, 4)], dim=1)  # of equals the first wins
    covariance, support = full.look(T.flatten(0, 1))
    winner = support.view(N, -1).argmax(dim=1) + torch.arange(N) * T.shape[1]
    return ContourFit(T.flatten(0, 1)[winner], covariance[winner], support[winner])


def _check(image: Tensor, box: Tensor, camera_matrix: Tensor, starts: Tensor, radius: float) -> None:
    check_tensor(image, "image", (None, None, None))
    check_tensor(box, "box", (4,))
    check_tensor(starts, "starts", (None, 4, 4))
    check_camera_matrix(camera_matrix)
    check_positive(radius, "radius")
    if not bool(torch.isfinite(starts).all()):
        raise InvalidInputError("starts: expected finite poses, got NaN or inf")


@dataclass(frozen=True)
class _Scene:
    """A mesh before one crop of the photograph: ``K`` (3, 3) and ``size`` of the crop."""

    renderer: DepthRenderer
    edges: EdgeField
    K: Tensor
    size: int
    centre: Tensor
    radius: float

    def points(self, T: Tensor) -> ContourPoints:
        depth = self.renderer.render(T, self.K, (self.size, self.size)).cpu()
        return contour_points(depth, T, self.K, radius=self.radius)

    def descend(self, T: Tensor, reaches: tuple[float, ...]) -> Tensor:
        for reach in reaches:
            points = self.points(T)
            for _ in range(STEPS):
                T = _moved(T, self._bounded(self._step(points, T, reach), T), self.centre)
        return T

    def _step(self, points: ContourPoints, T: Tensor, reach: float) -> Tensor:
        """(N, 6) turn about the centre and shift of it."""
        uv, du = _project(points.model, T, self.K, self.centre)
        J = (points.normals[..., None, :] @ du)[..., 0, :]
        distance, strength = self._candidates(uv, points, reach)
        step = torch.zeros(len(T), 6, dtype=torch.float64)
        for _ in range(SELECTIONS):
            left = distance - (J @ step[..., None])
            index = (strength * torch.exp(-2.0 * (left / reach) ** 2)).argmax(dim=-1, keepdim=True)
            tukey = (1.0 - (left.gather(-1, index) / reach) ** 2).clamp(min=0.0) ** 2
            W = strength.gather(-1, index) * tukey
            A = J.mT @ (W * J)
            b = J.mT @ (W * distance.gather(-1, index))
            damping = DAMPING * A.diagonal(dim1=-2, dim2=-1)
            floor = 1e-12 * damping.amax(dim=-1, keepdim=True) + 1e-12  # nothing found: no step
            step = torch.linalg.solve(A + torch.diag_embed(damping + floor), b)[..., 0]
        return step

    def _candidates(self, uv: Tensor, points: ContourPoints, reach: float) -> tuple[Tensor, Tensor]:
        """Distance in px along the normals and strength, both (N, P, L); the strength is 0 where there is no edge."""
        far = round(1.5 * reach) + 1
        offsets = torch.arange(-far, far + 1, dtype=torch.float64)
        profile = self.edges.strength(uv, points.normals, offsets)
        before, here, behind = profile[..., :-2], profile[..., 1:-1], profile[..., 2:]
        is_peak = (here > before) & (here >= behind) & points.valid[..., None]
        bend = (before - 2.0 * here + behind).clamp(max=-1e-9)
        vertex = (0.5 * (before - behind) / bend).clamp(-0.5, 0.5)  # of the parabola through the three
        return offsets[1:-1] + vertex, torch.where(is_peak, here, 0.0)

    def _bounded(self, step: Tensor, T: Tensor) -> Tensor:
        z = (T[:, :3, :3] @ self.centre + T[:, :3, 3])[:, 2].clamp(min=0.0)
        turn, shift = (torch.linalg.vector_norm(part, dim=1).clamp(min=1e-12) for part in step.split(3, dim=1))
        share = torch.minimum(MAX_TURN / turn, MAX_SHIFT * z / shift).clamp(max=1.0)
        return step * share[:, None]

    def look(self, T: Tensor) -> tuple[Tensor, Tensor]:
        """Covariance (N, 6, 6) and support (N,) of poses as they are."""
        points = self.points(T)
        uv, du = _project(points.model, T, self.K, self.centre)
        J = (points.normals[..., None, :] @ du)[..., 0, :]
        offsets = torch.arange(-3, 4, dtype=torch.float64)
        near = self.edges.strength(uv, points.normals, offsets) * torch.exp(-0.5 * offsets**2)
        valid = points.valid
        support = (near.amax(dim=-1) * valid).sum(dim=1) / valid.sum(dim=1).clamp(min=1)
        distance, strength = self._candidates(uv, points, FINE[-1])
        index = (strength * torch.exp(-0.5 * distance**2)).argmax(dim=-1, keepdim=True)
        d = distance.gather(-1, index)
        W = strength.gather(-1, index) * (1.0 - (d / FINE[-1]) ** 2).clamp(min=0.0) ** 2
        return _covariance(J, W, d, T[:, :3, :3] @ self.centre), support


def _covariance(J: Tensor, W: Tensor, d: Tensor, arm: Tensor) -> Tensor:
    """(N, 6, 6) of (turn, translation of the model's origin); ``arm`` (N, 3) leads from the origin to the centre."""
    freedom = W.sum(dim=(1, 2)) - 6.0
    variance = CORRELATED * (W * d * d).sum(dim=(1, 2)) / freedom.clamp(min=1e-9)
    A = J.mT @ (W * J)
    scale = A.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    unit = scale[:, :, None] * A * scale[:, None]  # a correlation matrix: its smallest eigenvalue has no unit
    known = (torch.linalg.eigvalsh(unit)[:, 0] > 1e-9) & (freedom > 0)
    unit = torch.where(known[:, None, None], unit, torch.eye(6, dtype=unit.dtype))
    C = variance[:, None, None] * scale[:, :, None] * torch.linalg.inv(unit) * scale[:, None]
    # The origin moves by e - w x arm where the centre moves by e.
    lever = torch.eye(6, dtype=C.dtype).repeat(len(C), 1, 1)
    lever[:, 3:, :3] = _cross(arm)
    C = lever @ C @ lever.mT
    return torch.where(known[:, None, None], 0.5 * (C + C.mT), torch.nan)


def _project(points: Tensor, T: Tensor, K: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (N, P, 2) of model points and their derivative (N, P, 2, 6) by a turn about the centre and its shift."""
    arms = (points - centre) @ T[:, :3, :3].mT
    cam = arms + (T[:, :3, :3] @ centre + T[:, :3, 3])[:, None]
    z = cam[..., 2:].clamp(min=1e-9)
    uv = cam @ K[:2].T / z
    by_cam = (K[:2] - uv[..., None] * K[2]) / z[..., None]
    by_step = torch.cat([-_cross(arms), torch.eye(3, dtype=z.dtype).expand(*arms.shape, 3)], dim=-1)
    return uv, by_cam @ by_step


def _moved(T: Tensor, step: Tensor, centre: Tensor) -> Tensor:
    """Turned by (N, 3) rad about the centre, which is then shifted by (N, 3)."""
    R = rotation_from_axis_angle(step[:, :3]) @ T[:, :3, :3]
    position = T[:, :3, :3] @ centre + T[:, :3, 3] + step[:, 3:]
    return transform(R, position - R @ centre)


def _cross(a: Tensor) -> Tensor:
    """(..., 3, 3) matrices of b -> a x b."""
    x, y, z = a.unbind(-1)
    o = torch.zeros_like(x)
    matrix: Tensor = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))
    return matrix
