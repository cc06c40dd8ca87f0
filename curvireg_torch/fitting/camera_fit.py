"""Cameras that are fitted together with poses, by least squares: their focal length, or the aspect
of their pixels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

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
    shifts,
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

MAX_CAMERA_STEP = 0.25  # Longest step of the logarithm of a factor


Powers: TypeAlias = Tensor | tuple[float, float, float, float, float]
"""What is not known of cameras is a factor. (5,), or (N, 5) for N cameras: with which of its powers
the focal lengths (fx, fy) grow, and the coordinates (x, y, z) of the object's centre in the camera,
so that its image keeps its place."""

FOCAL_LENGTH = (1.0, 1.0, 0.0, 0.0, 1.0)
"""The object moves away as the focal length grows, and its image keeps its size."""

ASPECT = (0.5, -0.5, -0.5, 0.5, 0.0)
"""Of fx / fy, which is also the factor by which a photograph was stretched horizontally."""


@dataclass(frozen=True)
class CameraPrior:
    """What is known of the cameras of N poses, with the ``powers`` of their unknown factors: the
    logarithms of these are ``log_factor`` (N,), with a standard ``deviation``, infinite if nothing
    is known, and stay within ``low`` and ``high`` (N,). Beyond ``reach``, the pull is constant."""

    log_factor: Tensor
    deviation: float
    low: Tensor
    high: Tensor
    reach: float = math.inf
    powers: Powers = FOCAL_LENGTH

    @staticmethod
    def usual(cameras: Tensor, size: tuple[int, int]) -> "CameraPrior":
        """That of an unknown focal length; ``cameras`` (N, 3, 3) are where fits begin."""
        longer = float(max(size))
        log = (cameras[:, 0, 0] / longer).log()
        low, high = (math.log(limit) - log for limit in FOCAL_LIMITS)
        return CameraPrior(math.log(USUAL_FOCAL) - log, FITTED_DEVIATION, low, high, FITTED_REACH)


@dataclass(frozen=True)
class CameraFit:
    """N poses in a ``state``, with the cameras of a ``problem``, which changed by factors whose
    logarithms are ``log_factor`` (N,)."""

    problem: ContourProblem
    state: ContourState
    log_factor: Tensor


def fit_camera(
    problem: ContourProblem,
    T: Tensor,
    prior: CameraPrior,
    radii: Sequence[float],
    matches: PointMatches | None = None,
) -> CameraFit:
    """Poses ``T`` (N, 4, 4) and cameras whose contours lie on edges, and whose surface where
    ``matches`` have it, in px of the problem: :meth:`ContourProblem.descend` with the logarithm of
    the prior's factor as a seventh unknown."""
    powers = prior.powers
    log_factor = torch.zeros(len(T), dtype=torch.float64)
    cameras = problem.K
    state = problem.state(T)
    for radius in radii:
        stiffness = torch.zeros_like(log_factor)
        if math.isfinite(prior.deviation):
            information, _ = camera_information(problem, state, radius, matches, powers)
            stiffness = information.scale / prior.deviation**2
        for _ in range(STEPS_PER_ROUND):
            uv, J = _projected(problem, state.T, state.points, powers)
            gap = prior.log_factor - log_factor
            pull = stiffness * (prior.reach / gap.abs().clamp(min=1e-9)).clamp(max=1.0)
            A = torch.zeros(len(T), 7, 7, dtype=torch.float64)
            A[:, 6, 6] = pull
            b = torch.zeros(len(T), 7, 1, dtype=torch.float64)
            b[:, 6, 0] = pull * gap
            others = [(A, b)]
            if matches is not None:
                found = matches.measurements(state.T, problem.K, problem.centre, radius)
                _, by_all = _projected(problem, state.T, matches.points, powers)
                others.append(replace(found, J=by_all).equations())
            step = problem.selected_step(state.points, uv, J, radius, others)
            fraction = problem.step_fraction(step[:, :6], state.T)
            fraction = torch.minimum(fraction, MAX_CAMERA_STEP / step[:, 6].abs().clamp(min=1e-9))
            step = step * fraction.clamp(max=1.0)[:, None]
            new = (log_factor + step[:, 6]).clamp(prior.low, prior.high)
            moved = apply_twist(state.T, step[:, :6], problem.centre)
            T = kept_in_place(moved, new - log_factor, problem.centre, powers)
            state = replace(state, T=T)
            log_factor = new
            problem = replace(problem, K=scaled_cameras(cameras, log_factor, powers))
        state = problem.with_current_contours(state)
    return CameraFit(problem, state, log_factor)


def scaled_cameras(cameras: Tensor, log_factor: Tensor, powers: Powers = FOCAL_LENGTH) -> Tensor:
    """(N, 3, 3) cameras that changed by factors, given as logarithms (N,)."""
    factor = torch.ones(len(cameras), 3, 1, dtype=cameras.dtype)
    factor[:, :2, 0] = (log_factor[:, None] * _as_tensor(powers)[..., :2]).exp()
    scaled = cameras * factor
    scaled[:, :2, 2] = cameras[:, :2, 2]
    return scaled


def kept_in_place(
    T: Tensor, log_factor: Tensor, centre: Tensor, powers: Powers = FOCAL_LENGTH
) -> Tensor:
    """(N, 4, 4) poses whose images have the same place after cameras changed by factors, given as
    logarithms (N,); the object turns with the ray through its centre."""
    before = point_in_cameras(T, centre)
    after = before * (log_factor[:, None] * _as_tensor(powers)[..., 2:]).exp()
    R = rotation_towards(after) @ rotation_towards(before).mT @ T[:, :3, :3]
    return pose_around(R, after, centre)


def _as_tensor(powers: Powers) -> Tensor:
    return torch.as_tensor(powers, dtype=torch.float64)


def _motion_with_camera(T: Tensor, centre: Tensor, powers: Powers) -> Tensor:
    """(N, 6) derivative of :func:`kept_in_place`: rotation about the centre in rad, and its
    translation."""
    position = point_in_cameras(T, centre)
    shift = position * _as_tensor(powers)[..., 2:]
    turn = torch.linalg.cross(position, shift) / position.square().sum(dim=1, keepdim=True)
    return torch.cat([turn, shift], dim=1)


def _projected(
    problem: ContourProblem, T: Tensor, points: ContourPoints, powers: Powers
) -> tuple[Tensor, Tensor]:
    """Pixels (N, P, 2) of points of the mesh, and the derivative (N, P, 7) of their shift along
    their normals by the pose and, with the motion of :func:`kept_in_place`, by the logarithm of the
    unknown factor."""
    uv, J = project(points.model, points.normals, T, problem.K, problem.centre)
    grown = (uv - problem.K[:, None, :2, 2]) * _as_tensor(powers)[..., None, :2]
    by_camera = (grown * points.normals).sum(dim=-1, keepdim=True)
    motion = _motion_with_camera(T, problem.centre, powers)
    return uv, torch.cat([J, by_camera + shifts(J, motion)], dim=-1)


@dataclass(frozen=True)
class CameraInformation:
    """What measurements tell of the logarithm of an unknown factor: the ``amount`` (N,) in the
    units of the normal equations, and the ``scale`` (N,) in px^2, by which one divides it to have
    the inverse of a variance; and the first ``step`` (N,) towards the best value."""

    amount: Tensor
    scale: Tensor
    step: Tensor

    @property
    def variance(self) -> Tensor:
        """(N,) of the logarithm."""
        return self.scale / self.amount.clamp(min=1e-12)


def camera_information(
    problem: ContourProblem,
    state: ContourState,
    radius: float,
    matches: PointMatches | None = None,
    powers: Powers = FOCAL_LENGTH,
) -> tuple[CameraInformation, Tensor]:
    """What edges within ``radius`` px, and ``matches``, tell of the logarithm of an unknown factor
    beyond what motions of the object could imitate, with errors as in :func:`pose_covariance`; and
    (N, 6), how the best pose moves with it."""
    measured, points = problem.measured(state, radius, matches)
    uv, by_all = _projected(problem, state.T, points, powers)
    J, by_camera = by_all.split([6, 1], dim=-1)
    W = measured.weight
    imitation = damped_solution(J.mT @ (W * J), J.mT @ (W * by_camera), 1e-6)
    own = by_camera - shifts(J, imitation)
    alone = Measurements(own, measured.distance, W)
    A, b = alone.equations()
    amount = A[:, 0, 0]
    step = b[:, 0, 0] / amount.clamp(min=1e-12)
    sums = summed_by_cells(uv, W * measured.distance * own)[..., 0]
    spread = sums.square().sum(dim=1) + residual_variance(measured) * (W * own).square().sum(
        dim=(1, 2)
    )
    scale = FOCAL_SCALE * spread / amount.clamp(min=1e-12)
    motion = _motion_with_camera(state.T, problem.centre, powers)
    return CameraInformation(amount, scale, step), motion - imitation
