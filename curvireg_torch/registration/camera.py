"""Focal lengths that are not known: cameras that are tried, and a focal length that is fitted with
the pose; and what a photograph says against the camera that is given.

Perspective shows the focal length: near parts of an object look larger, the more so the nearer the
camera is. Of five cameras, the one whose short fits have the most evidence is a start, from which
contours are fitted with log f as a seventh unknown. A prior on log f stays where perspective is too
weak to tell.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..fitting.camera_fit import (
    ASPECT,
    FOCAL_LENGTH,
    USUAL_DEVIATION,
    USUAL_FOCAL,
    CameraFit,
    CameraPrior,
    Powers,
    camera_information,
    fit_camera,
    kept_in_place,
    scaled_cameras,
)
from ..fitting.contour_problem import ContourProblem
from ..fitting.edges import EdgeCrops
from ..fitting.least_squares import PointMatches
from ..fitting.measured_fit import FULL_SIZE_RADII, ContourFit, measured_fit
from ..fitting.texture_fit import CONVINCING_RATIO, texture_matches
from ..geometry.cameras import camera_matrix, point_in_cameras, turn_with_ray
from ..geometry.conversions import cross_matrix
from ..matching import ViewDescriber
from .block import Block, Limits, least_starts, poses_of_views, with_evidence
from .confidence import are_near
from .hypotheses import Hypotheses, best_views, close_rivals, placed, with_short_fit
from .photograph import Photograph
from .result import Registration
from .target import Target

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


def off_axis_angle(item: Photograph) -> float:
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


def focal_prior(item: Photograph, cameras: Tensor) -> CameraPrior:
    """What is known of the focal length of a photograph's camera; ``cameras`` (N, 3, 3) are where
    fits begin."""
    if item.has_estimated_camera:
        return CameraPrior.usual(cameras, item.size)
    gap = (item.K[0, 0] / cameras[:, 0, 0]).log()
    reach = 4.0 * item.focal_deviation
    return CameraPrior(gap, item.focal_deviation, gap - reach, gap + reach)


def with_focal_length(
    describer: ViewDescriber, crops: EdgeCrops, poses: Hypotheses, item: Photograph
) -> Hypotheses:
    """Hypotheses of a photograph fitted at full size together with their focal lengths."""
    T = poses.T
    if item.has_estimated_camera:
        half = ContourProblem.of(
            describer.contours, crops, poses.cameras, poses.photograph, factor=2
        )
        coarse = fit_camera(half, T, focal_prior(item, poses.cameras), HALF_RADII)
        poses = replace(poses, cameras=scaled_cameras(poses.cameras, coarse.log_factor))
        T = coarse.state.T
    full = ContourProblem.of(describer.contours, crops, poses.cameras, poses.photograph)
    fit = fit_camera(full, T, focal_prior(item, poses.cameras), FULL_RADII)
    support = fit.problem.edge_support(fit.state)
    measured: ContourFit = measured_fit(fit.problem, fit.state, support, poses.start_support)
    cameras = scaled_cameras(poses.cameras, fit.log_factor)
    return replace(poses, cameras=cameras).with_fit(measured, describer.centre)


def zoomed(poses: Hypotheses, focal: Tensor, centre: Tensor) -> Hypotheses:
    """Poses whose images keep size and place while their cameras get the focal lengths ``focal``
    (N,) in px."""
    log_factor = (focal / poses.cameras[:, 0, 0]).log()
    moved = placed(poses, kept_in_place(poses.T, log_factor, centre), centre)
    return replace(moved, cameras=scaled_cameras(poses.cameras, log_factor))


def focal_covariance(
    describer: ViewDescriber, crops: EdgeCrops, pose: Hypotheses, item: Photograph
) -> tuple[Tensor, float]:
    """(1, 6, 6) covariance of one fitted pose with the error of its focal length, and the standard
    deviation of that, as a fraction."""
    full = ContourProblem.of(describer.contours, crops, pose.cameras, pose.photograph)
    state = full.state(pose.T)
    information, motion = camera_information(full, state, FULL_SIZE_RADII[-1])
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


OTHER_FOCAL = 0.2
"""Difference of log f from which a fit from another focal length may end elsewhere."""

SAME_SCORE = 0.2
"""Difference of scores that does not decide between focal lengths: 0.02 of similarity or edge
support."""


def limits_of(target: Target, item: Photograph) -> Limits:
    """The limits of a photograph that has any; an unknown camera counts as a usual one, and widens
    them."""
    assert item.prior is not None
    if item.camera is not None:
        return Limits(item, target.bank)
    if not target.is_exact:
        if item.prior.distance is not None:
            raise InvalidInputError(
                "distance: with a similar mesh, needs the camera of the photograph"
            )
        return Limits(item, target.bank)
    usual = item.by(usual_camera(item.size))
    return Limits(usual, target.bank, off_centre=off_axis_angle(usual))


def with_possible_cameras(target: Target, block: Block) -> tuple[Block, Hypotheses | None]:
    """Photographs whose camera is unknown with the best of several, and their starts, which have
    these; None without the contour fit, or where all cameras are known."""
    unknown = [p for p, item in enumerate(block.photographs) if item.camera is None]
    if not unknown:
        return block, None
    starts = (
        None if block.crops is None else _starts_of_cameras(target, block, block.crops, unknown)
    )
    changed = {}
    limits = list(block.limits)
    keypoints = list(block.keypoints)
    tried = block.tried_cameras.clone()
    for p in unknown:
        item = block.photographs[p]
        K = usual_camera(item.size) if starts is None else starts.cameras[starts.of(p)[0]]
        item = item.by(K, focal_deviation=USUAL_DEVIATION, source="estimated")
        changed[p] = item
        limits[p] = None if item.prior is None else Limits(item, target.bank)
        keypoints[p] = target.keypoint_matches(item, item.box) if target.uses_keypoints else None
        tried[p] = starts is not None
    block = replace(block, limits=limits, keypoints=keypoints, tried_cameras=tried)
    return block.with_photographs(changed), starts


def _starts_of_cameras(
    target: Target, block: Block, crops: EdgeCrops, unknown: Sequence[int]
) -> Hypotheses:
    """Starts in photographs whose camera is ``unknown``: of the best views with several cameras,
    those with the most evidence after a short fit, best first."""
    parts = []
    for p in unknown:
        view, rank = best_views(
            block.rankings[p], target.bank, count=TRIED_VIEWS, symmetries=block.symmetries
        )
        photograph = torch.full_like(view, p)
        for camera in possible_cameras(block.photographs[p].size):
            cameras = camera.expand(len(view), 3, 3)
            parts.append(poses_of_views(target, block, view, rank, photograph, cameras=cameras))
    poses = block.moved_inside(Hypotheses.cat(parts))
    poses, support = with_short_fit(target.describer, crops, poses)
    evidence = poses.rank + target.pipeline.fit.screening_weight * support
    chosen = []
    for p in unknown:
        rows = poses.of(p)
        of_fields = evidence[rows].view(len(FIELDS_OF_VIEW), -1)
        chosen.append(rows[best_of_fields(of_fields, least_starts(target))])
    return poses[torch.cat(chosen)]


def with_fitted_focal_lengths(
    target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses
) -> Hypotheses:
    """The best poses and close rivals of photographs whose focal length is uncertain, each fitted
    together with its own, where that does not lower its score noticeably: where perspective tells
    nothing, a usual focal length is better than one of those tried."""
    weights = target.score_weights(exact=True)
    behind = target.pipeline.fit.close_score
    for p, item in enumerate(block.photographs):
        if not item.focal_deviation:
            continue
        rows = poses.of(p)
        some = poses[rows]
        scores = some.scores(weights)
        tried = bool(block.tried_cameras[p])
        chosen = _to_be_fitted(block, some, scores, tried=tried, behind=behind)
        index, focal = _focal_starts(chosen, some.cameras[:, 0, 0])
        starts = zoomed(some[index], focal, target.describer.centre)
        fitted = with_focal_length(target.describer, crops, starts, item)
        fitted = with_evidence(target, block, fitted)
        gain = fitted.evidence.scores(weights) - scores[index]
        kept = block.keeps(fitted)
        for h in chosen.tolist():
            own = torch.where(index == h, gain, -torch.inf)
            best = own.argmax()[None]
            if float(own.max()) >= -SAME_SCORE and bool(kept[best]):
                poses = poses.with_poses(rows[index[best]], fitted[best])
    return poses


def _focal_starts(chosen: Tensor, focal: Tensor) -> tuple[Tensor, Tensor]:
    """(N,) poses and focal lengths that fits begin from: one camera took the photograph, so that
    the others also begin from the focal length of the first of the ``chosen`` poses (R,), and this
    one from that of the second. ``focal`` (H,) px is that of each pose."""
    first = chosen[:1].expand(len(chosen) - 1)
    others = chosen[1:]
    differ = (focal[first] / focal[others]).log().abs() > OTHER_FOCAL
    second = others[differ][:1]
    index = torch.cat([chosen, first[: len(second)], others[differ]])
    starts = torch.cat([focal[chosen], focal[second], focal[first[differ]]])
    return index, starts


def _to_be_fitted(
    block: Block, poses: Hypotheses, scores: Tensor, *, tried: bool, behind: float
) -> Tensor:
    """(R,) indices of the best poses of one photograph and, if cameras were ``tried``, of a rival
    that differs from them and, as its score is less than ``behind`` below, could be better with
    another focal length."""
    inside = int((~poses.is_outside).sum())
    if not tried:
        return scores.topk(min(1, inside)).indices
    best = scores.topk(min(FITTED, inside)).indices
    rivals = close_rivals(poses.rotation, scores, block.symmetries, behind=behind)
    for index in best:
        near = are_near(poses.rotation[rivals], poses.rotation[index], block.symmetries)
        rivals = rivals[~near]
    return torch.cat([best, rivals[:1]])


def with_focal_deviation(
    target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses
) -> tuple[Block, Hypotheses]:
    """Photographs whose focal length is uncertain with the camera of the best pose and what is
    known of its focal length, and the poses with the covariance that follows; the others have
    none."""
    changed = {}
    for row in poses.best(target.score_weights(exact=True)).split(1):
        p = int(poses.photograph[row])
        item = block.photographs[p]
        if not item.focal_deviation:
            continue
        covariance, deviation = focal_covariance(target.describer, crops, poses[row], item)
        if item.has_estimated_camera:
            centre = target.describer.centre
            covariance = covariance + principal_covariance(poses[row], item.size, centre)
        unknown = torch.full_like(poses.covariance, torch.nan).index_copy(0, row, covariance)
        is_here = (poses.photograph == p)[:, None, None]
        poses = replace(poses, covariance=torch.where(is_here, unknown, poses.covariance))
        changed[p] = item.by(poses.cameras[int(row)], focal_deviation=deviation)
    return block.with_photographs(changed), poses


CLEAR_DEVIATION = 0.3
"""Standard deviation of log f up to which a photograph determines its focal length."""

SMALLEST_GAP = 0.14
CONTRADICTION = 0.5
GIVEN_CONTRADICTION = 2.0
"""Difference of log f, 15 % of the distance, and how many standard deviations of a fit and of the
given focal length beside it, from which that is named. Those of fits are three times their errors;
the sum allows for scans, whose proportions are not quite those of the object. The first two also
hold of the logarithm of a factor by which a photograph is stretched: scans look stretched by up to
0.13, a picture of 5:4 that was made square is, by 0.22."""

NOTICED_STEP = 0.05
NOTICED_BY_PRINT = 0.02
"""First step of log f from which a focal length is fitted to contours, and to a print: with the
right camera most first steps are smaller, and a fit takes ten times as long as a step. Of 43
generated photographs without a print 7 have a larger one, of 33 with 0.7 and 1.3 times the focal
length all."""

UNKNOWN = torch.tensor([ASPECT, FOCAL_LENGTH], dtype=torch.float64)  # powers that are fitted

DOUBTFUL_ASPECT = 0.018
"""Standard deviation of log fx / fy at the fitted pose from which it is fitted: contours of
stretched photographs lie beside edges, which raises it to at least 0.016 in the 54 generated ones
that are named; of 70 others 44 have less than 0.018."""

WITHIN_REACH = 0.5
"""Standard deviation up to which, at the fitted pose, a focal length is worth a fit to contours. A
fit lowers the deviation, to a third where the given one is 1.3 times the right focal length. With
0.6, no more of 80 generated wrong ones are named."""

SHOWN_FOCAL_LENGTH = "the photograph shows a focal length"
STRETCHED = "the photograph looks stretched"
"""Beginnings of warnings of a camera that a photograph contradicts."""

LARGEST_CHANGE = 2.0  # of the logarithm of an unknown factor


def with_checked_cameras(
    target: Target,
    block: Block,
    crops: EdgeCrops,
    best: Hypotheses,
    results: Sequence[Registration],
) -> list[Registration]:
    """Results of photographs, whose ``best`` poses are one in each, with a warning where one is
    reliable and the photograph contradicts its camera: it looks stretched, or shows another focal
    length."""
    found = list(results)
    checked = [place for place, result in enumerate(found) if result.reliable]
    if not checked:
        return found
    items = [block.photographs[place] for place in checked]
    gaps, deviations = camera_gaps(
        target.describer,
        crops,
        best[checked],
        known=torch.tensor([not item.has_estimated_camera for item in items]),
        printed=torch.tensor([block.printed(place) > 0.0 for place in checked]),
    )
    for place, item, gap, deviation in zip(
        checked, items, gaps.tolist(), deviations.tolist(), strict=True
    ):
        text = stretch_contradiction(gap[0], deviation[0]) or focal_contradiction(
            float(best.cameras[place, 0, 0]),
            gap[1],
            deviation[1],
            given_deviation=item.focal_deviation,
        )
        if text is not None:
            result = found[place]
            found[place] = replace(result, warnings=(*result.warnings, text))
    return found


def camera_gaps(
    describer: ViewDescriber,
    crops: EdgeCrops,
    poses: Hypotheses,
    *,
    known: Tensor,
    printed: Tensor,
) -> tuple[Tensor, Tensor]:
    """How far photographs contradict the cameras of fitted poses.

    Args:
        describer: of the mesh.
        crops: of the photographs.
        poses: N > 0 of them.
        known: (N,) bool, whether the focal length is given, and compared.
        printed: (N,) bool, whether the photograph shows a print of the mesh, to which the focal
            length is then fitted as well.

    Returns:
        (N, 2) by how much the logarithms of fx / fy and of the focal length that a photograph shows
        exceed those of its camera, and (N, 2) their standard deviations, infinite where nobody
        looked further, as they seem right at the pose or after a fit at half the size, or the
        photograph does not determine them.
    """
    gap = torch.zeros(len(poses), 2, dtype=torch.float64)
    deviation = torch.full_like(gap, torch.inf)
    problem = ContourProblem.of(describer.contours, crops, poses.cameras, poses.photograph)
    twice = torch.arange(len(poses)).repeat(2)
    column = torch.arange(2).repeat_interleave(len(poses))
    state = problem.state(poses.T)[twice]
    first, _ = camera_information(problem[twice], state, FULL_SIZE_RADII[0], powers=UNKNOWN[column])
    expected = (REPORTED_VARIANCE * first.variance).sqrt().view(2, -1)
    step = torch.where(known, first.step.view(2, -1)[1].abs(), 0.0)
    by_contours = torch.stack(
        [expected[0] > DOUBTFUL_ASPECT, (step > NOTICED_STEP) & (expected[1] < WITHIN_REACH)]
    )
    for row in (printed & (step > NOTICED_BY_PRINT)).nonzero()[:, 0].tolist():
        one = slice(row, row + 1)
        found = _fitted_to_print(describer, crops, poses[one], problem[one])
        if found is not None:
            gap[row, 1], deviation[row, 1] = found
            by_contours[1, row] = False
    column, row = by_contours.nonzero().T
    if len(row):
        gap[row, column], deviation[row, column] = _fitted_to_contours(
            describer, crops, poses[row], column
        )
    return gap, torch.where(deviation < CLEAR_DEVIATION, deviation, torch.inf)


def _fitted_to_print(
    describer: ViewDescriber, crops: EdgeCrops, pose: Hypotheses, problem: ContourProblem
) -> tuple[Tensor, Tensor] | None:
    """Gap and deviation, see :func:`focal_gaps`, by contours and the print together, of one pose,
    that of a ``problem`` at full size; None where not enough of the print is found."""
    problem = replace(problem, mask=None)
    photograph = crops.crops[int(pose.photograph)]
    matches = texture_matches(describer.draw, describer.renderer, problem, photograph, pose.T)
    if matches is None:
        return None
    prior = _no_prior(pose.cameras, FOCAL_LENGTH)
    fit = fit_camera(problem, pose.T, prior, FULL_RADII, matches)
    ratio = matches.inlier_ratio(fit.state.T, fit.problem.K)
    if ratio < CONVINCING_RATIO:
        return None
    return fit.log_factor, _deviation(fit, FOCAL_LENGTH, matches)


def _fitted_to_contours(
    describer: ViewDescriber, crops: EdgeCrops, poses: Hypotheses, column: Tensor
) -> tuple[Tensor, Tensor]:
    """Gaps and deviations (N,), see :func:`camera_gaps`, in this ``column`` (N,), by contours
    alone."""
    powers = UNKNOWN[column]
    half = ContourProblem.of(describer.contours, crops, poses.cameras, poses.photograph, factor=2)
    coarse = fit_camera(half, poses.T, _no_prior(poses.cameras, powers), HALF_RADII)
    gap = coarse.log_factor
    deviation = torch.full_like(gap, torch.inf)
    far = (gap.abs() > 0.5 * SMALLEST_GAP).nonzero()[:, 0]
    if not len(far):
        return gap, deviation
    some = poses[far]
    powers = powers[far]
    cameras = scaled_cameras(some.cameras, gap[far], powers)
    full = ContourProblem.of(describer.contours, crops, cameras, some.photograph)
    fine = fit_camera(full, coarse.state.T[far], _no_prior(cameras, powers), FULL_RADII)
    gap = gap.index_add(0, far, fine.log_factor)
    return gap, deviation.index_copy(0, far, _deviation(fine, powers))


def _deviation(fit: CameraFit, powers: Powers, matches: PointMatches | None = None) -> Tensor:
    """(N,) standard deviation of the logarithm of an unknown factor."""
    information, _ = camera_information(
        fit.problem, fit.state, FULL_SIZE_RADII[-1], matches, powers
    )
    return (REPORTED_VARIANCE * information.variance).sqrt()


def _no_prior(cameras: Tensor, powers: Powers) -> CameraPrior:
    nothing = torch.zeros(len(cameras), dtype=torch.float64)
    low = nothing - LARGEST_CHANGE
    high = nothing + LARGEST_CHANGE
    return CameraPrior(nothing, math.inf, low, high, powers=powers)


def stretch_contradiction(gap: float, deviation: float) -> str | None:
    """What is wrong with a photograph that looks wider than by its camera, by a factor whose
    logarithm is ``gap``, with a standard ``deviation``; None if it is not clear.

    Example:
        >>> stretch_contradiction(0.22, 0.02)[:61]
        'the photograph looks stretched to 1.25 times its width; give '
        >>> stretch_contradiction(0.14, 0.02) is None
        True
    """
    if abs(gap) <= SMALLEST_GAP + CONTRADICTION * deviation:
        return None
    side = "width" if gap > 0.0 else "height"
    return (
        f"{STRETCHED} to {math.exp(abs(gap)):.2f} times its {side}; give it as "
        "it was taken, with its own camera, unless the object has other proportions than the mesh"
    )


def focal_contradiction(
    focal: float, gap: float, deviation: float, *, given_deviation: float = 0.0
) -> str | None:
    """What is wrong with a camera with the ``focal`` length in px, known up to
    ``given_deviation``, if the photograph shows one whose log is larger by ``gap``, with a standard
    ``deviation``; None if they agree, or if it is not clear.

    Example:
        >>> focal_contradiction(550.0, 0.7, 0.05)[:56]
        'the photograph shows a focal length of about 1108 px, no'
        >>> focal_contradiction(550.0, 0.1, 0.05) is None
        True
    """
    error = math.hypot(CONTRADICTION * deviation, GIVEN_CONTRADICTION * given_deviation)
    if abs(gap) <= SMALLEST_GAP + error:
        return None
    shown = focal * torch.tensor(gap).exp().item()
    return (
        f"{SHOWN_FOCAL_LENGTH} of about {shown:.0f} px, not the camera's "
        f"{focal:.0f} px: the camera is of a picture of another size, or this one was cropped, "
        f"stretched or zoomed; give its own camera, or none"
    )
