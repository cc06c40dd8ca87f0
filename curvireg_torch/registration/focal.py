"""Focal lengths that are not known: cameras that are tried, and a focal length that is fitted with
the pose.

Perspective shows the focal length: near parts of an object look larger, the more so the nearer the
camera is. Of five cameras, the one whose short fits have the most evidence is a start, from which
contours are fitted with log f as a seventh unknown. A prior on log f stays where perspective is too
weak to tell.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from ..fitting.contour_problem import ContourProblem
from ..fitting.edges import EdgeCrops
from ..fitting.focal_length import (
    USUAL_FOCAL,
    FocalPrior,
    fit_focal_length,
    focal_information,
    moved_away,
    scaled_cameras,
)
from ..fitting.measured_fit import FULL_SIZE_RADII, ContourFit, measured_fit
from ..geometry.cameras import camera_matrix, point_in_cameras, turn_with_ray
from ..geometry.conversions import cross_matrix
from ..matching import ViewDescriber
from .hypotheses import Hypotheses, placed
from .inputs import ImageItem

FIELDS_OF_VIEW = (12.0, 25.0, 45.0, 65.0, 85.0)
"""Degrees across the longer side of the photograph that are tried: factors of about 2 between focal
lengths."""

TRIED_VIEWS = 8
"""Best distinct views that are tried with each field of view."""

FITTED = 2
FINISHED = 3
"""Poses that are fitted with their focal lengths, and, before, those whose contours are fitted at
full size."""

REPORTED_VARIANCE = 0.6
"""Share that is reported of the variance with which focal lengths are fitted: on 45 photographs of
four sets with cameras, errors were 0.6 of the deviations of the whole (root mean square)."""

PRINCIPAL_DEVIATION = 0.2
"""Standard deviation of the principal point of an unknown camera, as a fraction of the photograph's
longer side: the photograph may have been cropped, which perspective hardly shows."""

HALF_RADII = (6.0, 4.0, 3.0)
FULL_RADII = FULL_SIZE_RADII
"""Search radii in px, one a round, of fits with a focal length."""


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


def best_of_fields(evidence: Tensor, count: int) -> Tensor:
    """Indices of starts whose ``evidence`` (F, V) is that of V views with each of F cameras: those
    that are fitted, the most evidence first. They are the best view with each camera, and at least
    ``count`` views with their best camera."""
    fields, views = evidence.shape
    of_field = evidence.argmax(dim=1) + views * torch.arange(fields)
    best, field = evidence.max(dim=0)
    order = best.argsort(descending=True, stable=True)[:count]
    of_view = order + views * field[order]
    chosen = torch.cat([of_field, of_view]).unique()
    best_first = evidence.flatten()[chosen].argsort(descending=True, stable=True)
    started: Tensor = chosen[best_first]
    return started


def focal_prior(item: ImageItem, cameras: Tensor) -> FocalPrior:
    """What is known of the focal length of a photograph's camera; ``cameras`` (N, 3, 3) are where
    fits begin."""
    if item.camera_source == "estimated":
        return FocalPrior.usual(cameras, item.size)
    gap = (item.K[0, 0] / cameras[:, 0, 0]).log()
    reach = 4.0 * item.focal_deviation
    return FocalPrior(gap, item.focal_deviation, gap - reach, gap + reach)


def with_focal_length(
    describer: ViewDescriber, crops: EdgeCrops, poses: Hypotheses, item: ImageItem
) -> Hypotheses:
    """Hypotheses of a photograph fitted at full size together with their focal lengths."""
    T = poses.T
    if item.camera_source == "estimated":
        half = ContourProblem.of(
            describer.contours, crops, poses.cameras, poses.photograph, factor=2
        )
        coarse = fit_focal_length(half, T, focal_prior(item, poses.cameras), HALF_RADII)
        poses = replace(poses, cameras=scaled_cameras(poses.cameras, coarse.log_zoom))
        T = coarse.state.T
    full = ContourProblem.of(describer.contours, crops, poses.cameras, poses.photograph)
    fit = fit_focal_length(full, T, focal_prior(item, poses.cameras), FULL_RADII)
    support = fit.problem.edge_support(fit.state)
    measured: ContourFit = measured_fit(fit.problem, fit.state, support, poses.start_support)
    cameras = scaled_cameras(poses.cameras, fit.log_zoom)
    return replace(poses, cameras=cameras).with_fit(measured, describer.centre)


def zoomed(poses: Hypotheses, focal: Tensor, centre: Tensor) -> Hypotheses:
    """Poses whose images keep size and place while their cameras get the focal lengths ``focal``
    (N,) in px."""
    log_zoom = (focal / poses.cameras[:, 0, 0]).log()
    moved = placed(poses, moved_away(poses.T, log_zoom, centre), centre)
    return replace(moved, cameras=scaled_cameras(poses.cameras, log_zoom))


def focal_covariance(
    describer: ViewDescriber, crops: EdgeCrops, pose: Hypotheses, item: ImageItem
) -> tuple[Tensor, float]:
    """(1, 6, 6) covariance of one fitted pose with the error of its focal length, and the standard
    deviation of that, as a fraction."""
    full = ContourProblem.of(describer.contours, crops, pose.cameras, pose.photograph)
    state = full.state(pose.T)
    information, motion = focal_information(full, state, FULL_SIZE_RADII[-1])
    measured = REPORTED_VARIANCE * information.variance
    variance = 1.0 / (1.0 / measured + 1.0 / item.focal_deviation**2)
    # From the translation of the centre to that of the origin, as in pose_covariance
    turn, shift = motion.split(3, dim=1)
    arm = pose.T[:, :3, :3] @ describer.centre
    shift = shift + (cross_matrix(arm) @ turn[..., None])[..., 0]
    motion = torch.cat([turn, shift], dim=1)
    covariance = pose.covariance + variance[:, None, None] * motion[:, :, None] * motion[:, None]
    return covariance, float(variance.sqrt())


def principal_covariance(pose: Hypotheses, size: tuple[int, int], centre: Tensor) -> Tensor:
    """(1, 6, 6) what the error of the principal point of an unknown camera adds to the covariance
    of one pose, in a photograph of ``size`` (H, W): the object moves across the optical axis and
    turns with the ray through its ``centre`` (3,), so that it looks the same."""
    position = point_in_cameras(pose.T, centre)
    pixels = PRINCIPAL_DEVIATION * max(size)
    across = torch.eye(3, dtype=torch.float64)[:2]
    shift = across * (pixels * position[0, 2] / pose.cameras[0, 0, 0])  # one row for each of x, y
    turn = shift @ turn_with_ray(position[0]).mT
    arm = (pose.T[0, :3, :3] @ centre).expand(2, 3)
    # from the translation of the centre to that of the origin, as in pose_covariance
    shift = shift + torch.linalg.cross(arm, turn)
    motion = torch.cat([turn, shift], dim=1)
    return (motion.mT @ motion)[None]
