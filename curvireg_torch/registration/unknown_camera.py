"""Photographs whose focal length is not known exactly, within a registration; :mod:`.focal` has the
mathematics."""

from dataclasses import replace

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..fitting.edges import EdgeCrops
from ..fitting.focal_length import USUAL_DEVIATION
from .candidates import Candidates
from .confidence import are_near
from .described import evidence_of
from .focal import (
    FITTED,
    TRIED_VIEWS,
    focal_covariance,
    off_axis_angle,
    possible_cameras,
    starts_of_fields,
    usual_camera,
    with_focal_length,
    zoomed,
)
from .inputs import ImageItem
from .poses import Poses, best_views, close_rivals
from .priors import Limits
from .target import Target
from .work import Work, least_starts, poses_of_views

OTHER_FOCAL = 0.2
"""Difference of log f from which a fit from another focal length may end elsewhere."""

SAME_SCORE = 0.2
"""Difference of scores that does not decide between focal lengths: 0.02 of similarity or edge
support."""


def limits_of(target: Target, item: ImageItem) -> Limits:
    """The limits of a photograph that has any; an unknown camera counts as a usual one, and widens
    them."""
    assert item.prior is not None
    if item.camera_matrix is not None:
        return Limits(item, target.bank)
    if not target.is_exact:
        if item.prior.distance is not None:
            raise InvalidInputError(
                "distance: with a similar mesh, needs the camera of the photograph"
            )
        return Limits(item, target.bank)
    usual = replace(item, camera_matrix=usual_camera(item.size))
    return Limits(usual, target.bank, off_centre=off_axis_angle(usual))


def with_possible_cameras(target: Target, work: Work) -> Work:
    """A photograph whose camera is unknown, with starts of several cameras, the best of which it
    has."""
    item = replace(work.item, focal_deviation=USUAL_DEVIATION, camera_source="estimated")
    starts: Poses | None = None
    K = usual_camera(item.size)
    if work.crops is not None:
        view, rank = best_views(
            work.ranking, target.bank, count=TRIED_VIEWS, symmetries=work.symmetries
        )
        of_cameras = []
        for camera in possible_cameras(item.size):
            seen = replace(work, item=replace(item, camera_matrix=camera))
            poses = poses_of_views(target, seen, view, rank)
            of_cameras.append(poses if work.limits is None else work.limits.moved_inside(poses))
        starts = starts_of_fields(
            target.describer,
            work.crops,
            of_cameras,
            least_starts(target),
            screening_weight=target.pipeline.fit.screening_weight,
        )
        K = starts.cameras[0]
    item = replace(item, camera_matrix=K)
    limits = None if item.prior is None else Limits(item, target.bank)
    keypoints = target.keypoint_matches(item, item.box) if target.uses_keypoints else None
    return replace(work, item=item, limits=limits, keypoints=keypoints, starts=starts)


def with_fitted_focal_lengths(
    target: Target, work: Work, crops: EdgeCrops, found: Candidates
) -> Candidates:
    """The best poses and close rivals, each fitted together with its own focal length, where that
    does not lower its score noticeably: where perspective tells nothing, a usual focal length is
    better than one of those tried."""
    weights = target.score_weights(exact=True)
    scores = found.scores(weights)
    inside = int((~found.outside).sum())
    behind = target.pipeline.fit.close_score
    chosen = _to_be_fitted(work, found.poses, scores, inside, behind=behind)
    index, focal = _focal_starts(chosen, found.poses.cameras[:, 0, 0])
    starts = zoomed(found.poses[index], focal, target.describer.centre)
    fitted = with_focal_length(target.describer, crops, starts, work.item)
    new = evidence_of(target, work, fitted)
    gain = new.scores(weights) - scores[index]
    for h in chosen.tolist():
        own = torch.where(index == h, gain, -torch.inf)
        if float(own.max()) >= -SAME_SCORE:
            best = own.argmax()[None]
            found = found.with_fitted(index[best], fitted[best], new[best], work.limits)
    return found


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
    work: Work, poses: Poses, scores: Tensor, inside: int, *, behind: float
) -> Tensor:
    """(R,) indices of the best poses and, of an unknown camera, of a rival that differs from them
    and, as its score is less than ``behind`` below, could be better with another focal length;
    ``inside`` poses may be chosen."""
    if work.starts is None:
        return scores.topk(min(1, inside)).indices
    best = scores.topk(min(FITTED, inside)).indices
    rivals = close_rivals(poses, scores, work.symmetries, behind=behind)
    for index in best:
        rivals = rivals[~are_near(poses.rotation[rivals], poses.rotation[index], work.symmetries)]
    return torch.cat([best, rivals[:1]])


def with_focal_deviation(
    target: Target, work: Work, crops: EdgeCrops, found: Candidates
) -> tuple[Work, Candidates]:
    """The photograph with the camera of the best pose and what is known of its focal length, and
    the poses with the covariance that follows; the others have none."""
    best = found.best(target.score_weights(exact=True))
    poses = found.poses
    covariance, deviation = focal_covariance(target.describer, crops, poses[best], work.item)
    unknown = torch.full_like(poses.covariance, torch.nan).index_copy(0, best, covariance)
    item = replace(work.item, camera_matrix=poses.cameras[int(best)], focal_deviation=deviation)
    poses = replace(poses, covariance=unknown)
    return replace(work, item=item), replace(found, poses=poses)
