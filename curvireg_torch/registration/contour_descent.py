"""Poses pulled onto edges by robust least squares: the inside of :func:`fit_contours`."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry import rotation_from_axis_angle
from ..geometry.cameras import transform
from ..rendering import DepthRenderer
from .contour_points import ContourPoints, EdgeField, contour_points

__all__ = ["Matches", "Seen", "Views", "cross", "moved", "project"]

STEPS, SELECTIONS = 2, 3
"""Least-squares steps per round, and choices of edges per step."""

STALE = 0.3
"""Mean way in px of contour points on the mesh, after which the mesh is rendered anew."""

DAMPING = 1e-2
"""Levenberg-Marquardt: share of its own diagonal that is added to J^T W J."""

MAX_TURN, MAX_SHIFT = 0.2, 0.1
"""Longest step: radians, and share of the object's distance."""


@dataclass(frozen=True)
class Matches:
    """Contour points of N poses and the edges that they lie by: derivatives ``J`` (N, P, 6) of the distance along the
    normal, that distance in px and its weight, (N, P, 1)."""

    J: Tensor
    distance: Tensor
    weight: Tensor


@dataclass(frozen=True)
class Seen:
    """N poses ``T`` on their way, (N, 4, 4), the poses ``rendered`` in which the mesh was last rendered, near them, and
    the contour points seen from there."""

    T: Tensor
    rendered: Tensor
    points: ContourPoints

    def __getitem__(self, index: Tensor) -> "Seen":
        return Seen(self.T[index], self.rendered[index], self.points[index])

    @staticmethod
    def cat(parts: Sequence["Seen"]) -> "Seen":
        T, rendered = (torch.cat([getattr(part, name) for part in parts]) for name in ("T", "rendered"))
        return Seen(T, rendered, ContourPoints.cat([part.points for part in parts]))


@dataclass(frozen=True)
class Views:
    """N poses of a mesh, each before the crop of its photograph.

    Attributes:
        renderer: of the mesh.
        edges: of B crops.
        photograph: (N,) which of them a pose belongs to.
        K: (N, 3, 3) of the crops.
        size: of the crops in px.
        centre, radius: of the object, (3,) and model units.
    """

    renderer: DepthRenderer
    edges: EdgeField
    photograph: Tensor
    K: Tensor
    size: int
    centre: Tensor
    radius: float

    def of(self, index: Tensor) -> "Views":
        return Views(
            self.renderer, self.edges, self.photograph[index], self.K[index], self.size, self.centre, self.radius
        )

    def seen(self, T: Tensor) -> Seen:
        """Poses (N, 4, 4) and their contour points."""
        size = (self.size, self.size)
        depth = self.renderer.render(T, self.K, size).cpu() if len(T) else torch.zeros(0, 1, *size)
        return Seen(T, T, contour_points(depth, T, self.K, radius=self.radius))

    def descend(self, seen: Seen, reaches: tuple[float, ...]) -> Seen:
        """One round per reach; the mesh is rendered anew where contours have moved."""
        for reach in reaches:
            T = seen.T
            for _ in range(STEPS):
                T = moved(T, self._bounded(self._step(seen.points, T, reach), T), self.centre)
            seen = self._refreshed(Seen(T, seen.rendered, seen.points))
        return seen

    def _refreshed(self, seen: Seen) -> Seen:
        # Each pose by itself: a result does not depend on what shares its batch.
        stale = self.way(seen.points, seen.rendered, seen.T) > STALE
        if not bool(stale.any()):
            return seen
        new, every = self.of(stale.nonzero()[:, 0]).seen(seen.T[stale]), torch.arange(len(stale))
        return Seen.cat([seen, new])[torch.where(stale, len(stale) - 1 + stale.cumsum(0), every)]

    def way(self, points: ContourPoints, before: Tensor, after: Tensor) -> Tensor:
        """(N,) mean way in px of the points from one pose to another."""
        way = pixels(points.model, after, self.K, self.centre) - pixels(points.model, before, self.K, self.centre)
        length = torch.linalg.vector_norm(way, dim=-1) * points.valid
        mean: Tensor = length.sum(dim=1) / points.valid.sum(dim=1).clamp(min=1)
        return mean

    def _step(self, points: ContourPoints, T: Tensor, reach: float) -> Tensor:
        """(N, 6) turn about the centre and shift of it."""
        uv, du = project(points.model, T, self.K, self.centre)
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
        profile = self.edges.strength(uv, points.normals, offsets, self.photograph)
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

    def edge_support(self, seen: Seen) -> Tensor:
        """(N,) mean strength of the edges within about 1 px of the contour points."""
        points = seen.points
        uv = pixels(points.model, seen.T, self.K, self.centre)
        offsets = torch.arange(-3, 4, dtype=torch.float64)
        near = self.edges.strength(uv, points.normals, offsets, self.photograph) * torch.exp(-0.5 * offsets**2)
        return (near.amax(dim=-1) * points.valid).sum(dim=1) / points.valid.sum(dim=1).clamp(min=1)

    def matches(self, seen: Seen, reach: float) -> Matches:
        """What the last round's least squares saw."""
        points = seen.points
        uv, du = project(points.model, seen.T, self.K, self.centre)
        distance, strength = self._candidates(uv, points, reach)
        index = (strength * torch.exp(-0.5 * distance**2)).argmax(dim=-1, keepdim=True)
        d = distance.gather(-1, index)
        W = strength.gather(-1, index) * (1.0 - (d / reach) ** 2).clamp(min=0.0) ** 2
        return Matches((points.normals[..., None, :] @ du)[..., 0, :], d, W)


def project(points: Tensor, T: Tensor, K: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (N, P, 2) of model points and their derivative (N, P, 2, 6) by a turn about the centre and its shift."""
    K = K.expand(len(T), 3, 3)
    arms = (points - centre) @ T[:, :3, :3].mT
    cam = arms + (T[:, :3, :3] @ centre + T[:, :3, 3])[:, None]
    z = cam[..., 2:].clamp(min=1e-9)
    uv = cam @ K[:, :2].mT / z
    by_cam = (K[:, None, :2] - uv[..., None] * K[:, None, 2:]) / z[..., None]
    by_turn = torch.linalg.cross(arms[..., None, :].expand_as(by_cam), by_cam)  # b . (w x a) = w . (a x b)
    return uv, torch.cat([by_turn, by_cam], dim=-1)


def pixels(points: Tensor, T: Tensor, K: Tensor, centre: Tensor) -> Tensor:
    """Those of :func:`project` alone."""
    cam = (points - centre) @ T[:, :3, :3].mT + (T[:, :3, :3] @ centre + T[:, :3, 3])[:, None]
    return cam @ K[:, :2].mT / cam[..., 2:].clamp(min=1e-9)


def moved(T: Tensor, step: Tensor, centre: Tensor) -> Tensor:
    """Turned by (N, 3) rad about the centre, which is then shifted by (N, 3)."""
    R = rotation_from_axis_angle(step[:, :3]) @ T[:, :3, :3]
    position = T[:, :3, :3] @ centre + T[:, :3, 3] + step[:, 3:]
    return transform(R, position - R @ centre)


def cross(a: Tensor) -> Tensor:
    """(..., 3, 3) matrices of b -> a x b."""
    x, y, z = a.unbind(-1)
    o = torch.zeros_like(x)
    matrix: Tensor = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))
    return matrix
