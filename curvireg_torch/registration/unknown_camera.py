"""Photographs whose focal length is not known exactly, within a registration; :mod:`.focal` has the
mathematics."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..fitting.edges import EdgeCrops
from ..fitting.focal_length import USUAL_DEVIATION
from .block import Block, least_starts, poses_of_views
from .confidence import are_near
from .described import with_evidence
from .focal import (
    FIELDS_OF_VIEW,
    FITTED,
    TRIED_VIEWS,
    best_of_fields,
    focal_covariance,
    off_axis_angle,
    possible_cameras,
    principal_covariance,
    usual_camera,
    with_focal_length,
    zoomed,
)
from .hypotheses import Hypotheses, best_views, close_rivals, with_short_fit
from .inputs import ImageItem
from .priors import Limits
from .target import Target

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


def with_possible_cameras(target: Target, block: Block) -> tuple[Block, Hypotheses | None]:
    """Photographs whose camera is unknown with the best of several, and their starts, which have
    these; None without the contour fit, or where all cameras are known."""
    unknown = [p for p, item in enumerate(block.photographs) if item.camera_matrix is None]
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
        item = replace(
            item,
            camera_matrix=K,
            focal_deviation=USUAL_DEVIATION,
            camera_source="estimated",
        )
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
            seen = replace(block.photographs[p], camera_matrix=camera)
            parts.append(
                poses_of_views(target, block.with_photographs({p: seen}), view, rank, photograph)
            )
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
    rivals = close_rivals(poses, scores, block.symmetries, behind=behind)
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
        if item.camera_source == "estimated":
            centre = target.describer.centre
            covariance = covariance + principal_covariance(poses[row], item.size, centre)
        unknown = torch.full_like(poses.covariance, torch.nan).index_copy(0, row, covariance)
        is_here = (poses.photograph == p)[:, None, None]
        poses = replace(poses, covariance=torch.where(is_here, unknown, poses.covariance))
        K = poses.cameras[int(row)]
        changed[p] = replace(item, camera_matrix=K, focal_deviation=deviation)
    return block.with_photographs(changed), poses
