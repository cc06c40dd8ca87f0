"""Focal lengths that are not known: cameras that are tried, and a focal length that is fitted with
the pose.

Perspective shows the focal length: near parts of an object look larger, the more so the nearer the
camera is. Of five cameras, the one whose quick fits have the most evidence is a start, from which
contours are fitted with log f as a seventh unknown. A prior on log f stays where perspective is too
weak to tell.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..geometry.cameras import camera_matrix, rotation_towards, transform
from ..geometry.conversions import cross_matrix
from ..matching import ViewDescriber
from .contour_fit import (
    FULL_SIZE_RADII,
    STEPS_PER_ROUND,
    ContourFit,
    ContourProblem,
    ContourState,
    measured_fit,
)
from .edges import EdgeCrops
from .inputs import ImageItem
from .least_squares import (
    Measurements,
    apply_twist,
    damped_solution,
    project,
    residual_variance,
    summed_by_cells,
)
from .poses import SCREENING_WEIGHT, Poses, with_quick_fit

FIELDS_OF_VIEW = (12.0, 25.0, 45.0, 65.0, 85.0)
"""Degrees across the longer side of the photograph that are tried: factors of about 2 between focal
lengths."""

TRIED_VIEWS = 8
"""Best distinct views that are tried with each field of view."""

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

FITTED = 2
FINISHED = 3
"""Poses that are fitted with their focal lengths, and, before, those whose contours are fitted at
full size."""

HALF_RADII = (6.0, 4.0, 3.0)
FULL_RADII = FULL_SIZE_RADII
"""Search radii in px, one a round, of fits with a focal length."""

MAX_FOCAL_STEP = 0.25  # Longest step of log f


def usual_camera(size: tuple[int, int]) -> Tensor:
    """(3, 3) camera matrix with the usual focal length for a photograph of (H, W)."""
    return _camera(size, USUAL_FOCAL * max(size))


def possible_cameras(size: tuple[int, int]) -> list[Tensor]:
    """(3, 3) camera matrices of ``FIELDS_OF_VIEW`` for a photograph of (H, W)."""
    half = [math.radians(degrees) / 2.0 for degrees in FIELDS_OF_VIEW]
    return [_camera(size, 0.5 * max(size) / math.tan(angle)) for angle in half]


def off_axis_angle(item: ImageItem) -> float:
    """Degrees between the optical axis and the ray through the centre of a photograph's box."""
    x, y = ((item.box[:2] + item.box[2:]).double() / 2.0 - item.K[:2, 2]).tolist()
    return math.degrees(math.atan(math.hypot(x, y) / float(item.K[0, 0])))


def _camera(size: tuple[int, int], focal: float) -> Tensor:
    H, W = size
    return camera_matrix(focal, focal, (W - 1) / 2, (H - 1) / 2)


def starts_of_fields(
    describer: ViewDescriber, crops: EdgeCrops, starts: Sequence[Poses], count: int
) -> Poses:
    """Of ``starts``, the same views with each of several cameras, those that are fitted, with their
    quick fits and the most evidence first: the best view with each camera, and at least ``count``
    views with their best camera."""
    poses, support = with_quick_fit(describer, crops, Poses.cat(starts))
    evidence = (poses.rank + SCREENING_WEIGHT * support).view(len(starts), -1)
    views = evidence.shape[1]
    of_field = evidence.argmax(dim=1) + views * torch.arange(len(starts))
    best, field = evidence.max(dim=0)
    order = best.argsort(descending=True, stable=True)[:count]
    of_view = order + views * field[order]
    chosen = torch.cat([of_field, of_view]).unique()
    best_first = evidence.flatten()[chosen].argsort(descending=True, stable=True)
    return poses[chosen[best_first]]


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

    @staticmethod
    def of(item: ImageItem, cameras: Tensor) -> "FocalPrior":
        """That of a photograph's camera."""
        if item.camera_source == "estimated":
            return FocalPrior.usual(cameras, item.size)
        gap = (item.K[0, 0] / cameras[:, 0, 0]).log()
        reach = 4.0 * item.focal_deviation
        return FocalPrior(gap, item.focal_deviation, gap - reach, gap + reach)


@dataclass(frozen=True)
class FocalFit:
    """N poses in a ``state``, with the cameras of a ``problem``, whose focal lengths grew by
    ``log_zoom`` (N,)."""

    problem: ContourProblem
    state: ContourState
    log_zoom: Tensor


def fit_focal_length(
    problem: ContourProblem, T: Tensor, prior: FocalPrior, radii: Sequence[float]
) -> FocalFit:
    """Poses ``T`` (N, 4, 4) and focal lengths whose contours lie on edges:
    :meth:`ContourProblem.descend` with log f as a seventh unknown. While it changes, the object
    moves so that its image keeps size and place."""
    log_zoom = torch.zeros(len(T), dtype=torch.float64)
    cameras = problem.K
    state = problem.state(T)
    for radius in radii:
        information, _ = focal_information(problem, state, radius)
        stiffness = information.scale / prior.deviation**2
        for _ in range(STEPS_PER_ROUND):
            uv, J = project(
                state.points.model, state.points.normals, state.T, problem.K, problem.centre
            )
            J = torch.cat([J, _by_focal_length(problem, state, uv, J)[..., None]], dim=-1)
            gap = prior.log_zoom - log_zoom
            pull = stiffness * (prior.reach / gap.abs().clamp(min=1e-9)).clamp(max=1.0)
            A = torch.zeros(len(T), 7, 7, dtype=torch.float64)
            A[:, 6, 6] = pull
            b = torch.zeros(len(T), 7, 1, dtype=torch.float64)
            b[:, 6, 0] = pull * gap
            step = problem.selected_step(state.points, uv, J, radius, [(A, b)])
            fraction = problem.step_fraction(step[:, :6], state.T)
            fraction = torch.minimum(fraction, MAX_FOCAL_STEP / step[:, 6].abs().clamp(min=1e-9))
            step = step * fraction.clamp(max=1.0)[:, None]
            new = (log_zoom + step[:, 6]).clamp(prior.low, prior.high)
            moved = apply_twist(state.T, step[:, :6], problem.centre)
            state = replace(state, T=_moved_away(moved, new - log_zoom, problem.centre))
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


def _moved_away(T: Tensor, log_zoom: Tensor, centre: Tensor) -> Tensor:
    """(N, 4, 4) poses whose images, by cameras with focal lengths longer by factors, have the same
    size and place; the object turns with the ray through its centre."""
    before = T[:, :3, :3] @ centre + T[:, :3, 3]
    after = before.clone()
    after[:, 2] *= log_zoom.exp()
    R = rotation_towards(after) @ rotation_towards(before).mT @ T[:, :3, :3]
    return transform(R, after - R @ centre)


def _motion_with_focal_length(T: Tensor, centre: Tensor) -> Tensor:
    """(N, 6) derivative of :func:`_moved_away`: rotation about the centre in rad, and its
    translation."""
    position = T[:, :3, :3] @ centre + T[:, :3, 3]
    away = position * position.new_tensor([0.0, 0.0, 1.0])
    turn = torch.linalg.cross(position, away) / position.square().sum(dim=1, keepdim=True)
    return torch.cat([turn, away], dim=1)


def _by_focal_length(problem: ContourProblem, state: ContourState, uv: Tensor, J: Tensor) -> Tensor:
    """(N, P) derivative by log f of the shift of points at ``uv`` (N, P, 2) px along their normals,
    with the motion of :func:`_moved_away`; ``J`` (N, P, 6) is that by the pose."""
    zoom = ((uv - problem.K[:, None, :2, 2]) * state.points.normals).sum(dim=-1)
    motion = _motion_with_focal_length(state.T, problem.centre)
    return zoom + (J @ motion[..., None])[..., 0]


@dataclass(frozen=True)
class FocalInformation:
    """What edges tell of log f: the ``amount`` (N,) in the units of the normal equations, and the
    ``scale`` (N,) in px^2, by which one divides it to have the inverse of a variance."""

    amount: Tensor
    scale: Tensor

    @property
    def variance(self) -> Tensor:
        """(N,) of log f."""
        return self.scale / self.amount.clamp(min=1e-12)


def focal_information(
    problem: ContourProblem, state: ContourState, radius: float
) -> tuple[FocalInformation, Tensor]:
    """What edges within ``radius`` px tell of log f beyond what motions of the object could
    imitate, with errors as in :func:`pose_covariance`; and (N, 6), how the best pose moves with log
    f."""
    measured = problem.measured_edges(state, radius)
    uv, J = project(state.points.model, state.points.normals, state.T, problem.K, problem.centre)
    by_focal = _by_focal_length(problem, state, uv, J)[..., None]
    W = measured.weight
    imitation = damped_solution(J.mT @ (W * J), J.mT @ (W * by_focal), 1e-6)
    own = by_focal - J @ imitation[..., None]
    alone = Measurements(own, measured.distance, W)
    amount = alone.equations()[0][:, 0, 0]
    sums = summed_by_cells(uv, W * measured.distance * own)[..., 0]
    spread = sums.square().sum(dim=1) + residual_variance(measured) * (W * own).square().sum(
        dim=(1, 2)
    )
    scale = FOCAL_SCALE * spread / amount.clamp(min=1e-12)
    return FocalInformation(amount, scale), _motion_with_focal_length(
        state.T, problem.centre
    ) - imitation


def with_focal_length(
    describer: ViewDescriber, crops: EdgeCrops, poses: Poses, item: ImageItem
) -> Poses:
    """Poses of a photograph fitted at full size together with their focal lengths."""
    T = poses.T
    if item.camera_source == "estimated":
        half = ContourProblem.of(
            describer.contours, crops, poses.cameras, poses.crop_index, factor=2
        )
        coarse = fit_focal_length(half, T, FocalPrior.of(item, poses.cameras), HALF_RADII)
        poses = replace(poses, cameras=scaled_cameras(poses.cameras, coarse.log_zoom))
        T = coarse.state.T
    full = ContourProblem.of(describer.contours, crops, poses.cameras, poses.crop_index)
    fit = fit_focal_length(full, T, FocalPrior.of(item, poses.cameras), FULL_RADII)
    support = fit.problem.edge_support(fit.state)
    measured: ContourFit = measured_fit(fit.problem, fit.state, support, poses.start_support)
    cameras = scaled_cameras(poses.cameras, fit.log_zoom)
    return replace(poses, cameras=cameras).with_fit(measured, describer.centre)


def focal_covariance(
    describer: ViewDescriber, crops: EdgeCrops, pose: Poses, item: ImageItem
) -> tuple[Tensor, float]:
    """(1, 6, 6) covariance of one fitted pose with the error of its focal length, and the standard
    deviation of that, as a fraction."""
    full = ContourProblem.of(describer.contours, crops, pose.cameras, pose.crop_index)
    state = full.state(pose.T)
    information, motion = focal_information(full, state, FULL_SIZE_RADII[-1])
    variance = 1.0 / (1.0 / information.variance + 1.0 / item.focal_deviation**2)
    # From the translation of the centre to that of the origin, as in pose_covariance
    turn, shift = motion.split(3, dim=1)
    arm = pose.T[:, :3, :3] @ describer.centre
    shift = shift + (cross_matrix(arm) @ turn[..., None])[..., 0]
    motion = torch.cat([turn, shift], dim=1)
    covariance = pose.covariance + variance[:, None, None] * motion[:, :, None] * motion[:, None]
    return covariance, float(variance.sqrt())
