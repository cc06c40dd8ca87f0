"""Robust least squares that pulls poses onto edges: the inner loop of :func:`fit_contours`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...geometry import rotation_from_axis_angle
from ...geometry.cameras import transform
from ...rendering.contours import ContourPoints, MeshContours
from .mask import ObjectMask
from .points import EdgeField

__all__ = ["ContourProblem", "ContourState", "Matches", "apply_twist", "project"]

STEPS, SELECTIONS = 2, 3
"""Least-squares steps per round, and selections of edges per step."""

STALE = 0.3
"""Mean shift of the contour points in px after which the mesh is rendered again."""

DAMPING = 1e-2
"""Levenberg-Marquardt: fraction of the diagonal of J^T W J that is added to it."""

MAX_ROTATION, MAX_TRANSLATION = 0.2, 0.1
"""Longest step: radians, and fraction of the object's distance."""


@dataclass(frozen=True)
class Matches:
    """Edges matched to the contour points of N poses: derivatives ``J`` (N, P, 6) of the distance along the normal,
    that distance in px and its weight, (N, P, 1)."""

    J: Tensor
    distance: Tensor
    weight: Tensor


@dataclass(frozen=True)
class ContourState:
    """N poses ``T`` (N, 4, 4), nearby poses ``rendered`` (N, 4, 4) in which the mesh was last rendered, and the contour
    points of that rendering."""

    T: Tensor
    rendered: Tensor
    points: ContourPoints

    def __getitem__(self, index: Tensor) -> "ContourState":
        return ContourState(self.T[index], self.rendered[index], self.points[index])

    @staticmethod
    def cat(parts: Sequence["ContourState"]) -> "ContourState":
        T, rendered = (torch.cat([getattr(part, name) for part in parts]) for name in ("T", "rendered"))
        return ContourState(T, rendered, ContourPoints.cat([part.points for part in parts]))


@dataclass(frozen=True)
class ContourProblem:
    """N poses of a mesh, fitted to ``edges`` of crops of ``size`` px with indices (N,) and cameras ``K`` (N, 3, 3); a
    ``mask`` weights the edges."""

    contours: MeshContours
    edges: EdgeField
    image_index: Tensor
    K: Tensor
    size: int
    mask: ObjectMask | None = None

    @property
    def centre(self) -> Tensor:
        """(3,) of the object, about which poses rotate."""
        return self.contours.centre

    def __getitem__(self, index: Tensor) -> "ContourProblem":
        return replace(self, image_index=self.image_index[index], K=self.K[index])

    def state(self, T: Tensor) -> ContourState:
        """Poses (N, 4, 4) with the mesh's contour points there."""
        return ContourState(T, T, self.contours.points(T, self.K, self.size))

    def descend(self, state: ContourState, reaches: tuple[float, ...]) -> ContourState:
        """One round for each search distance in px; afterwards the mesh is rendered again where contours moved."""
        for reach in reaches:
            T = state.T
            for _ in range(STEPS):
                T = self.step(state.points, T, reach)
            state = self.rendered_again(replace(state, T=T))
        return state

    def rendered_again(self, state: ContourState) -> ContourState:
        # Decided for each pose separately: a result must not depend on the rest of the batch.
        stale = self.mean_shift(state.points, state.rendered, state.T) > STALE
        if not bool(stale.any()):
            return state
        new = self[stale.nonzero()[:, 0]].state(state.T[stale])
        index = torch.where(stale, len(stale) - 1 + stale.cumsum(0), torch.arange(len(stale)))
        return ContourState.cat([state, new])[index]

    def mean_shift(self, points: ContourPoints, before: Tensor, after: Tensor) -> Tensor:
        """(N,) mean shift of the points in px between two poses."""
        shift = pixels(points.model, after, self.K, self.centre) - pixels(points.model, before, self.K, self.centre)
        length = torch.linalg.vector_norm(shift, dim=-1) * points.valid
        mean: Tensor = length.sum(dim=1) / points.valid.sum(dim=1).clamp(min=1)
        return mean

    def step(
        self, points: ContourPoints, T: Tensor, reach: float, others: tuple[Tensor, Tensor] | None = None
    ) -> Tensor:
        """(N, 4, 4) poses after a least-squares step towards edges within ``reach`` px.

        ``others``, (N, 6, 6) and (N, 6), are normal equations of further measurements, which are added.
        """
        return apply_twist(T, self._bounded(self._solve(points, T, reach, others), T), self.centre)

    def _solve(self, points: ContourPoints, T: Tensor, reach: float, others: tuple[Tensor, Tensor] | None) -> Tensor:
        """(N, 6) rotation about the centre and translation of it."""
        uv, du = project(points.model, T, self.K, self.centre)
        J = (points.normals[..., None, :] @ du)[..., 0, :]
        distance, strength = self._candidates(uv, points, reach)
        if self.mask is not None:
            strength = strength * self.mask.weights(uv, points, _offsets(reach)[1:-1], self.image_index, self.size)
        step = torch.zeros(len(T), 6, dtype=torch.float64)
        for _ in range(SELECTIONS):
            residual = distance - (J @ step[..., None])
            index = (strength * torch.exp(-2.0 * (residual / reach) ** 2)).argmax(dim=-1, keepdim=True)
            tukey = (1.0 - (residual.gather(-1, index) / reach) ** 2).clamp(min=0.0) ** 2
            W = strength.gather(-1, index) * tukey
            A = J.mT @ (W * J)
            b = J.mT @ (W * distance.gather(-1, index))
            if others is not None:
                A, b = A + others[0], b + others[1][..., None]
            damping = DAMPING * A.diagonal(dim1=-2, dim2=-1)
            least = 1e-12 * damping.amax(dim=-1, keepdim=True) + 1e-12  # without matches the step is 0
            step = torch.linalg.solve(A + torch.diag_embed(damping + least), b)[..., 0]
        return step

    def _candidates(self, uv: Tensor, points: ContourPoints, reach: float) -> tuple[Tensor, Tensor]:
        """Distances in px along the normals and strengths, both (N, P, L); the strength is 0 where there is no edge."""
        offsets = _offsets(reach)
        profile = self.edges.strength(uv, points.normals, offsets, self.image_index)
        before, here, behind = profile[..., :-2], profile[..., 1:-1], profile[..., 2:]
        is_peak = (here > before) & (here >= behind) & points.valid[..., None]
        curvature = (before - 2.0 * here + behind).clamp(max=-1e-9)
        vertex = (0.5 * (before - behind) / curvature).clamp(-0.5, 0.5)  # of the parabola through the three values
        return offsets[1:-1] + vertex, torch.where(is_peak, here, 0.0)

    def _bounded(self, step: Tensor, T: Tensor) -> Tensor:
        z = (T[:, :3, :3] @ self.centre + T[:, :3, 3])[:, 2].clamp(min=0.0)
        w, t = (torch.linalg.vector_norm(part, dim=1).clamp(min=1e-12) for part in step.split(3, dim=1))
        fraction = torch.minimum(MAX_ROTATION / w, MAX_TRANSLATION * z / t).clamp(max=1.0)
        return step * fraction[:, None]

    def edge_support(self, state: ContourState) -> Tensor:
        """(N,) mean strength of the edges within about 1 px of the contour points."""
        return self.supports(state)[0]

    def supports(self, state: ContourState) -> tuple[Tensor, Tensor]:
        """(N,) :meth:`edge_support`, and the same with the weights of the mask, if there is one: what fits are compared
        by."""
        points = state.points
        uv = pixels(points.model, state.T, self.K, self.centre)
        offsets = torch.arange(-3, 4, dtype=torch.float64)
        near = self.edges.strength(uv, points.normals, offsets, self.image_index) * torch.exp(-0.5 * offsets**2)
        plain = (near.amax(dim=-1) * points.valid).sum(dim=1) / points.valid.sum(dim=1).clamp(min=1)
        if self.mask is None:
            return plain, plain
        near = near * self.mask.weights(uv, points, offsets, self.image_index, self.size)
        most = self.mask.largest_weights(points) * points.valid  # a long outline alone is no support
        return plain, (near.amax(dim=-1) * points.valid).sum(dim=1) / most.sum(dim=1).clamp(min=1)

    def matches(self, state: ContourState, reach: float) -> Matches:
        """The edges that a least-squares step without a mask would use."""
        points = state.points
        uv, du = project(points.model, state.T, self.K, self.centre)
        distance, strength = self._candidates(uv, points, reach)
        index = (strength * torch.exp(-0.5 * distance**2)).argmax(dim=-1, keepdim=True)
        d = distance.gather(-1, index)
        W = strength.gather(-1, index) * (1.0 - (d / reach) ** 2).clamp(min=0.0) ** 2
        return Matches((points.normals[..., None, :] @ du)[..., 0, :], d, W)


def _offsets(reach: float) -> Tensor:
    """Offsets in px at which edges are searched within ``reach`` of a predicted position."""
    far = round(1.5 * reach) + 1
    return torch.arange(-far, far + 1, dtype=torch.float64)


def project(points: Tensor, T: Tensor, K: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (N, P, 2) of model points, and their derivative (N, P, 2, 6) by rotation about and translation of the
    centre."""
    K = K.expand(len(T), 3, 3)
    arms = (points - centre) @ T[:, :3, :3].mT
    cam = arms + (T[:, :3, :3] @ centre + T[:, :3, 3])[:, None]
    z = cam[..., 2:].clamp(min=1e-9)
    uv = cam @ K[:, :2].mT / z
    by_cam = (K[:, None, :2] - uv[..., None] * K[:, None, 2:]) / z[..., None]
    by_rotation = torch.linalg.cross(arms[..., None, :].expand_as(by_cam), by_cam)  # b . (w x a) = w . (a x b)
    return uv, torch.cat([by_rotation, by_cam], dim=-1)


def pixels(points: Tensor, T: Tensor, K: Tensor, centre: Tensor) -> Tensor:
    """The pixels of :func:`project` without their derivative."""
    cam = (points - centre) @ T[:, :3, :3].mT + (T[:, :3, :3] @ centre + T[:, :3, 3])[:, None]
    return cam @ K[:, :2].mT / cam[..., 2:].clamp(min=1e-9)


def apply_twist(T: Tensor, step: Tensor, centre: Tensor) -> Tensor:
    """(N, 4, 4) poses, rotated by ``step[:, :3]`` rad about the centre, which is then translated by ``step[:, 3:]``."""
    R = rotation_from_axis_angle(step[:, :3]) @ T[:, :3, :3]
    position = T[:, :3, :3] @ centre + T[:, :3, 3] + step[:, 3:]
    return transform(R, position - R @ centre)
