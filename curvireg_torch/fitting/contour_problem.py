"""Steps of a contour fit: projected contours of the mesh are pulled onto image edges."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from ..rendering.contours import ContourPoints, MeshContours
from ..utils.rows import Rows
from .edges import CROP_SIZE, EdgeCrops, EdgeField, ObjectMask, PosesByPicture
from .least_squares import (
    Measurements,
    PointMatches,
    apply_twist,
    damped_solution,
    pixels,
    project,
    shifts,
    step_fraction,
)

COARSE_DENSITY = 0.25
DENSITY = {1: 1.0, 2: 0.5, 4: COARSE_DENSITY}
"""Contour points in crops whose sides are smaller by a factor, as a fraction of those at full size.
``COARSE_DENSITY`` also holds at half size where starts are compared."""

STEPS_PER_ROUND = 2
SELECTIONS_PER_STEP = 3
"""Least-squares steps per round, and selections of edges per step."""

STALE_SHIFT = 0.6
"""Mean shift of the contour points in px after which the mesh's contours are found again."""

NEAR = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
"""Offsets in px at which edges support a contour point."""

NO_EDGE = 1e-30
"""Strength below which there is no edge."""

EDGE_DAMPING = 1e-2
"""Levenberg-Marquardt: fraction of the diagonal of J^T W J that is added to it."""


@dataclass(frozen=True)
class ContourState(Rows):
    """Poses ``T`` (N, 4, 4), nearby ones ``seen`` at which contours were last found, and the
    contour points there."""

    T: Tensor
    seen: Tensor
    points: ContourPoints


@dataclass(frozen=True)
class ContourProblem(Rows):
    """N poses of a mesh, fitted to ``edges`` of crops of ``size`` px with indices (N,) and cameras
    ``K`` (N, 3, 3); a ``mask`` weights the edges."""

    contours: MeshContours
    edges: EdgeField
    image_index: Tensor
    K: Tensor
    size: int
    mask: ObjectMask | None = None
    density: float = 1.0

    @classmethod
    def of(
        cls,
        contours: MeshContours,
        crops: EdgeCrops,
        K: Tensor,
        image_index: Tensor | None = None,
        *,
        factor: int = 1,
    ) -> "ContourProblem":
        """The problem in ``crops`` whose sides are smaller by a ``factor``, with cameras ``K`` (N,
        3, 3) of the whole photographs ``image_index`` (N,), by default the first."""
        index = torch.zeros(len(K), dtype=torch.long, device=K.device)
        index = index if image_index is None else image_index
        scales = torch.tensor([1.0 / factor, 1.0 / factor, 1.0], dtype=K.dtype, device=K.device)
        shrink = torch.diag(scales)
        shrink[:2, 2] = 0.5 / factor - 0.5
        K = shrink @ crops.transforms[index] @ K
        return cls(
            contours,
            crops.edges(factor),
            index,
            K,
            CROP_SIZE // factor,
            crops.mask,
            DENSITY[factor],
        )

    @cached_property
    def poses(self) -> PosesByPicture:
        """The poses by crop."""
        return PosesByPicture(self.image_index)

    @property
    def centre(self) -> Tensor:
        """(3,) of the object, about which poses rotate."""
        return self.contours.centre

    def state(self, T: Tensor) -> ContourState:
        """Poses (N, 4, 4) with the mesh's contour points there."""
        return ContourState(T, T, self.contours.points(T, self.K, self.size, density=self.density))

    def descend(self, state: ContourState, radii: Sequence[float]) -> ContourState:
        """Poses after one round for each search radius in px; contours are found again where they
        moved."""
        for radius in radii:
            state = self.with_current_contours(self.moved(state, radius))
        return state

    def moved(self, state: ContourState, radius: float) -> ContourState:
        """Poses after one round, with their contours as they were."""
        T = state.T
        for _ in range(STEPS_PER_ROUND):
            T = self.step(state.points, T, radius)
        return replace(state, T=T)

    def with_current_contours(self, state: ContourState) -> ContourState:
        # Decided for each pose separately: up to rounding, a result must not depend on the rest of
        # the batch.
        stale = self.mean_shift(state.points, state.seen, state.T) > STALE_SHIFT
        if not bool(stale.any()):
            return state
        new = self[stale.nonzero()[:, 0]].state(state.T[stale])
        every = torch.arange(len(stale), device=stale.device)
        index = torch.where(stale, len(stale) - 1 + stale.cumsum(0), every)
        return ContourState.cat([state, new])[index]

    def mean_shift(self, points: ContourPoints, before: Tensor, after: Tensor) -> Tensor:
        """(N,) mean shift of the points in px between two poses."""
        shift = pixels(points.model, after, self.K) - pixels(points.model, before, self.K)
        length = torch.linalg.vector_norm(shift, dim=-1) * points.valid
        mean: Tensor = length.sum(dim=1) / points.valid.sum(dim=1).clamp(min=1)
        return mean

    def step(
        self, points: ContourPoints, T: Tensor, radius: float, others: Sequence[Measurements] = ()
    ) -> Tensor:
        """(N, 4, 4) poses after a least-squares step towards edges within ``radius`` px and
        ``others`` measurements."""
        uv, J = project(points.model, points.normals, T, self.K, self.centre)
        step = self.selected_step(points, uv, J, radius, [other.equations() for other in others])
        return apply_twist(T, step * self.step_fraction(step, T)[:, None], self.centre)

    def selected_step(
        self,
        points: ContourPoints,
        uv: Tensor,
        J: Tensor,
        radius: float,
        equations: Sequence[tuple[Tensor, Tensor]],
    ) -> Tensor:
        """(N, D) solutions for edges within ``radius`` px of points at ``uv`` (N, P, 2) px, which
        shift along their normals by ``J`` (N, P, D), and of other normal ``equations``; edges are
        selected again near the solution."""
        distance, strength = self._candidates(uv, points, radius)
        J = J.to(distance.dtype)
        if self.mask is not None:
            strength = strength * self.mask.weights(
                uv, points, _offsets(radius)[1:-1], self.poses, self.size
            )
        # The logarithm of 0 takes ten times as long as that of other numbers.
        log = strength.clamp(min=NO_EDGE).log()

        def solved(residual: Tensor) -> Tensor:
            # The largest strength times exp(-2 (residual / radius)^2)
            agreement = torch.addcmul(log, residual, residual, value=-2.0 / radius**2)
            index = agreement.max(dim=-1, keepdim=True).indices  # faster than argmax
            tukey = (1.0 - (residual.gather(-1, index) / radius).square()).clamp(min=0.0).square()
            edges = Measurements(J, distance.gather(-1, index), strength.gather(-1, index) * tukey)
            A, b = (each.double() for each in edges.equations())
            for more_A, more_b in equations:
                A = A + more_A
                b = b + more_b
            return self.solution(A, b)

        step = solved(distance)
        for _ in range(SELECTIONS_PER_STEP - 1):
            step = solved(distance - shifts(J, step.to(J.dtype)))
        return step

    def solution(self, A: Tensor, b: Tensor) -> Tensor:
        """(N, 6) damped solutions of normal equations (N, 6, 6) and (N, 6, 1)."""
        return damped_solution(A, b, EDGE_DAMPING)

    def step_fraction(self, step: Tensor, T: Tensor) -> Tensor:
        """(N,) see :func:`step_fraction`."""
        return step_fraction(step, T, self.centre)

    def _candidates(
        self, uv: Tensor, points: ContourPoints, radius: float
    ) -> tuple[Tensor, Tensor]:
        """Distances in px along the normals and strengths, both (N, P, L) float32, enough for a
        step; the strength is 0 where there is no edge."""
        offsets = _offsets(radius)
        profile = self.edges.strength(uv, points.normals, offsets, self.poses)
        before = profile[..., :-2]
        here = profile[..., 1:-1]
        behind = profile[..., 2:]
        is_peak = (here > before) & (here >= behind) & points.valid[..., None]
        curvature = (before - 2.0 * here + behind).clamp(max=-1e-9)
        # of the parabola through the three values
        vertex = (0.5 * (before - behind) / curvature).clamp(-0.5, 0.5)
        middle = torch.tensor(offsets[1:-1], dtype=torch.float32, device=uv.device)
        return middle + vertex, torch.where(is_peak, here, 0.0)

    def edge_support(self, state: ContourState) -> Tensor:
        """(N,) mean strength of the edges within about 1 px of the contour points."""
        return self.supports(state)[0]

    def supports(self, state: ContourState) -> tuple[Tensor, Tensor]:
        """(N,) :meth:`edge_support`, and the same with the weights of the mask, if there is one:
        what fits are compared by."""
        points = state.points
        uv = pixels(points.model, state.T, self.K)
        counts = self.edges.counts(uv, points.valid, self.image_index)
        near = self._near(uv, points.normals)
        plain = (near.amax(dim=-1).double() * counts).sum(dim=1) / counts.sum(dim=1).clamp(min=1)
        if self.mask is None:
            return plain, plain
        near = near * self.mask.weights(uv, points, NEAR, self.poses, self.size)
        most = self.mask.largest_weights(points) * counts  # a long outline alone is no support
        return plain, (near.amax(dim=-1).double() * counts).sum(dim=1) / most.sum(dim=1).clamp(
            min=1
        )

    def strength_near(self, uv: Tensor, normals: Tensor) -> Tensor:
        """(N, P) float64 strength of the edges within about 1 px of points (N, P, 2) px with
        ``normals`` (N, P, 2)."""
        return self._near(uv, normals).amax(dim=-1).double()

    def _near(self, uv: Tensor, normals: Tensor) -> Tensor:
        """(N, P, 7) strengths at ``NEAR`` px along the normals, which fall with the distance from
        the point."""
        offsets = torch.tensor(NEAR, dtype=torch.float32, device=uv.device)
        strength = self.edges.strength(uv, normals, NEAR, self.poses)
        return strength * torch.exp(-0.5 * offsets**2)

    def measured_edges(self, state: ContourState, radius: float) -> Measurements:
        """The edges that a least-squares step without a mask would use."""
        points = state.points
        uv, J = project(points.model, points.normals, state.T, self.K, self.centre)
        distance, strength = self._candidates(uv, points, radius)
        index = (strength * torch.exp(-0.5 * distance**2)).argmax(dim=-1, keepdim=True)
        d = distance.gather(-1, index).double()
        W = strength.gather(-1, index) * (1.0 - (d / radius) ** 2).clamp(min=0.0) ** 2
        return Measurements(J, d, W)

    def measured(
        self, state: ContourState, radius: float, matches: PointMatches | None = None
    ) -> tuple[Measurements, ContourPoints]:
        """The :meth:`measured_edges`, then the ``matches`` with robust weights whose scale is the
        ``radius``; and the points of the mesh that both belong to."""
        edges = self.measured_edges(state, radius)
        if matches is None:
            return edges, state.points
        found = matches.measurements(state.T, self.K, self.centre, radius)
        points = ContourPoints.cat_within([state.points, matches.points])
        return Measurements.cat_within([edges, found]), points


def _offsets(radius: float) -> tuple[float, ...]:
    """Offsets in px at which edges are searched within ``radius`` of a predicted position."""
    far = round(1.5 * radius) + 1
    return tuple(float(offset) for offset in range(-far, far + 1))
