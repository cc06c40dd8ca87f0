"""Focal lengths that are fitted together with poses, by least squares."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..geometry.cameras import point_in_cameras, pose_around, rotation_towards
from ..rendering.contours import ContourPoints
from .contour_problem import STEPS_PER_ROUND, ContourProblem, ContourState
from .least_squares import (
    Measurements,
    PointMatches,
    apply_twist,
    damped_solution,
    project,
    residual_variance,
    summed_by_cells,
)

USUAL_FOCAL = 0.8
USUAL_DEVIATION = 0.7
"""Focal length of unknown cameras as a multiple of the photograph's longer side, and standard
deviation of its logarithm: telephones have about 0.75, telephoto lenses 5."""

FOCAL_LIMITS = (0.35, 8.0)
"""Multiples of the longer side that an estimated focal length stays within: 110 and 7 degrees."""

FITTED_DEVIATION = 0.5
FITTED_REACH = 0.35
"""Deviation of the prior while an unknown focal length is fitted, and difference of log f from
which its pull does not grow: telephones are the rule, and what is far from them must not be pulled
far."""

FOCAL_SCALE = 16.0
"""Factor of the least-squares variance of log f, chosen on generated photographs and on photographs
with cameras."""

MAX_FOCAL_STEP = 0.25  # Longest step of log f


@dataclass(frozen=True)
class FocalPrior:
    """What is known of the focal lengths of N poses: log f is ``log_zoom`` (N,) more than that of
    their cameras, with a standard ``deviation``, and stays within ``low`` and ``high`` (N,) of it.
    Beyond ``reach``, its pull is constant."""

    log_zoom: Tensor
    deviation: float
    low: Tensor
    high: Tensor
    reach: float = math.inf

    @staticmethod
    def usual(cameras: Tensor, size: tuple[int, int]) -> "FocalPrior":
        """That of an unknown camera; ``cameras`` (N, 3, 3) are where fits begin."""
        longer = float(max(size))
        log = (cameras[:, 0, 0] / longer).log()
        low, high = (math.log(limit) - log for limit in FOCAL_LIMITS)
        return FocalPrior(math.log(USUAL_FOCAL) - log, FITTED_DEVIATION, low, high, FITTED_REACH)


@dataclass(frozen=True)
class FocalFit:
    """N poses in a ``state``, with the cameras of a ``problem``, whose focal lengths grew by
    ``log_zoom`` (N,)."""

    problem: ContourProblem
    state: ContourState
    log_zoom: Tensor


def fit_focal_length(
    problem: ContourProblem,
    T: Tensor,
    prior: FocalPrior,
    radii: Sequence[float],
    matches: PointMatches | None = None,
) -> FocalFit:
    """Poses ``T`` (N, 4, 4) and focal lengths whose contours lie on edges, and whose surface where
    ``matches`` have it, in px of the problem: :meth:`ContourProblem.descend` with log f as a
    seventh unknown. While it changes, the object moves so that its image keeps size and place."""
    log_zoom = torch.zeros(len(T), dtype=torch.float64)
    cameras = problem.K
    state = problem.state(T)
    for radius in radii:
        information, _ = focal_information(problem, state, radius, matches)
        stiffness = information.scale / prior.deviation**2
        for _ in range(STEPS_PER_ROUND):
            uv, J = _projected(problem, state.T, state.points)
            gap = prior.log_zoom - log_zoom
            pull = stiffness * (prior.reach / gap.abs().clamp(min=1e-9)).clamp(max=1.0)
            A = torch.zeros(len(T), 7, 7, dtype=torch.float64)
            A[:, 6, 6] = pull
            b = torch.zeros(len(T), 7, 1, dtype=torch.float64)
            b[:, 6, 0] = pull * gap
            others = [(A, b)]
            if matches is not None:
                found = matches.measurements(state.T, problem.K, problem.centre, radius)
                _, by_all = _projected(problem, state.T, matches.points)
                others.append(replace(found, J=by_all).equations())
            step = problem.selected_step(state.points, uv, J, radius, others)
            fraction = problem.step_fraction(step[:, :6], state.T)
            fraction = torch.minimum(fraction, MAX_FOCAL_STEP / step[:, 6].abs().clamp(min=1e-9))
            step = step * fraction.clamp(max=1.0)[:, None]
            new = (log_zoom + step[:, 6]).clamp(prior.low, prior.high)
            moved = apply_twist(state.T, step[:, :6], problem.centre)
            state = replace(state, T=moved_away(moved, new - log_zoom, problem.centre))
            log_zoom = new
            problem = replace(problem, K=scaled_cameras(cameras, log_zoom))
        state = problem.state(state.T)
    return FocalFit(problem, state, log_zoom)


def scaled_cameras(cameras: Tensor, log_zoom: Tensor) -> Tensor:
    """(N, 3, 3) cameras whose focal lengths are longer by factors, given as logarithms (N,)."""
    factor = torch.ones(len(cameras), 3, 1, dtype=cameras.dtype)
    factor[:, :2, 0] = log_zoom.exp()[:, None]
    scaled = cameras * factor
    scaled[:, :2, 2] = cameras[:, :2, 2]
    return scaled


def moved_away(T: Tensor, log_zoom: Tensor, centre: Tensor) -> Tensor:
    """(N, 4, 4) poses whose images, by cameras with focal lengths longer by factors, have the same
    size and place; the object turns with the ray through its centre."""
    before = point_in_cameras(T, centre)
    after = before.clone()
    after[:, 2] *= log_zoom.exp()
    R = rotation_towards(after) @ rotation_towards(before).mT @ T[:, :3, :3]
    return pose_around(R, after, centre)


def _motion_with_focal_length(T: Tensor, centre: Tensor) -> Tensor:
    """(N, 6) derivative of :func:`moved_away`: rotation about the centre in rad, and its
    translation."""
    position = point_in_cameras(T, centre)
    away = position * position.new_tensor([0.0, 0.0, 1.0])
    turn = torch.linalg.cross(position, away) / position.square().sum(dim=1, keepdim=True)
    return torch.cat([turn, away], dim=1)


def _projected(problem: ContourProblem, T: Tensor, points: ContourPoints) -> tuple[Tensor, Tensor]:
    """Pixels (N, P, 2) of points of the mesh, and the derivative (N, P, 7) of their shift along
    their normals by the pose and, with the motion of :func:`moved_away`, by log f."""
    uv, J = project(points.model, points.normals, T, problem.K, problem.centre)
    zoom = ((uv - problem.K[:, None, :2, 2]) * points.normals).sum(dim=-1, keepdim=True)
    motion = _motion_with_focal_length(T, problem.centre)
    return uv, torch.cat([J, zoom + J @ motion[..., None]], dim=-1)


@dataclass(frozen=True)
class FocalInformation:
    """What measurements tell of log f: the ``amount`` (N,) in the units of the normal equations,
    and the ``scale`` (N,) in px^2, by which one divides it to have the inverse of a variance; and
    the first ``step`` (N,) of log f towards its best value."""

    amount: Tensor
    scale: Tensor
    step: Tensor

    @property
    def variance(self) -> Tensor:
        """(N,) of log f."""
        return self.scale / self.amount.clamp(min=1e-12)


def focal_information(
    problem: ContourProblem,
    state: ContourState,
    radius: float,
    matches: PointMatches | None = None,
) -> tuple[FocalInformation, Tensor]:
    """What edges within ``radius`` px, and ``matches``, tell of log f beyond what motions of the
    object could imitate, with errors as in :func:`pose_covariance`; and (N, 6), how the best pose
    moves with log f."""
    points = state.points
    measured = problem.measured_edges(state, radius)
    if matches is not None:
        points = ContourPoints.cat_within([points, matches.points])
        found = matches.measurements(state.T, problem.K, problem.centre, radius)
        measured = Measurements.cat_within([measured, found])
    uv, by_all = _projected(problem, state.T, points)
    J, by_focal = by_all.split([6, 1], dim=-1)
    W = measured.weight
    imitation = damped_solution(J.mT @ (W * J), J.mT @ (W * by_focal), 1e-6)
    own = by_focal - J @ imitation[..., None]
    alone = Measurements(own, measured.distance, W)
    A, b = alone.equations()
    amount = A[:, 0, 0]
    step = b[:, 0, 0] / amount.clamp(min=1e-12)
    sums = summed_by_cells(uv, W * measured.distance * own)[..., 0]
    spread = sums.square().sum(dim=1) + residual_variance(measured) * (W * own).square().sum(
        dim=(1, 2)
    )
    scale = FOCAL_SCALE * spread / amount.clamp(min=1e-12)
    return FocalInformation(amount, scale, step), _motion_with_focal_length(
        state.T, problem.centre
    ) - imitation
