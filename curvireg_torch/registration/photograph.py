"""One photograph with a box: rank views, fit the contours of the most promising, judge, report."""

from contextlib import suppress
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CurviregError
from ..evidence import Evidence
from ..fitting.edges import EdgeCrops
from ..matching import Ranking
from ..terms import QueryFeatures
from .confidence import are_near
from .described import evidence_of
from .focal import FINISHED
from .framing import shown_in, whole_boxes
from .inputs import ImageItem, check_crop
from .judging import judged
from .mirror import compared_with_mirror_image
from .poses import (
    Poses,
    best_views,
    common_score,
    distinct_poses,
    fit_texture_of,
    projected_box,
    with_edge_support,
    with_quick_fit,
)
from .priors import Limits
from .refits import best_inside, fitted_again
from .result import Registration
from .search import search
from .siblings import Rival, with_siblings
from .target import Target
from .unknown_camera import (
    limits_of,
    with_fitted_focal_lengths,
    with_focal_deviation,
    with_possible_cameras,
)
from .work import (
    Work,
    fitted_poses,
    keypoint_poses,
    least_starts,
    poses_in_box,
    poses_of_views,
    with_replaced,
)


def register_item(target: Target, item: ImageItem) -> Registration:
    """Register a photograph with a box, and again if its pose asks for another box."""
    result = _register_box(target, item)
    # Without a camera, poses are derived from their boxes.
    if target.pipeline.box_jitter and target.pipeline.contours and result.camera is not None:
        box = projected_box(target.describer, result.projection)
        # in a frame and without one, similarities mean different things
        alike = target.has_frame(item.box, item.size) == target.has_frame(box, item.size)
        if alike and item.shows_other_part(box):
            with suppress(CurviregError):
                again = _register_box(target, replace(item, box=box.float()))
                weights = target.score_weights(exact=True)
                new = common_score(again.hypotheses[0], weights)
                if new > common_score(result.hypotheses[0], weights):
                    result = replace(again, corrected_box=box)
    return result


def _register_box(target: Target, item: ImageItem) -> Registration:
    query = target.matcher.query_together(item.image, item.box)
    check_crop(query.crops[0])
    return register(target, item, query)


@torch.no_grad()
def register(target: Target, item: ImageItem, query: QueryFeatures) -> Registration:
    """Register a photograph: rank, fit, judge, report.

    Args:
        item: the photograph.
        query: the same, cropped and described by the matcher.
    """
    work = _rank(target, item, query)
    if work.exact and item.camera_matrix is None:
        work = with_possible_cameras(target, work)
    if target.pipeline.search:
        return _searched(target, work)
    starts, outside, repeated = _starts(target, work)
    poses = starts
    if work.crops is not None:
        target.report_progress("contours")
        unknown = poses.quick[:, 0, 0].isnan().nonzero()[:, 0]
        if len(unknown):
            poses = poses.replaced(
                unknown, with_quick_fit(target.describer, work.crops, poses[unknown])[0]
            )
        finish = target.pipeline.fit.finished_fits if work.starts is None else FINISHED
        if work.frame is not None:  # at the border as many poses of larger boxes compete
            finish *= 2
        poses = fitted_poses(target, work, work.crops, poses, quick=poses.quick, finish=finish)
    evidence = evidence_of(target, work, poses)
    sibling = Rival.none(poses, evidence)
    if work.crops is not None and work.exact:
        if work.item.focal_deviation:
            poses, evidence = with_fitted_focal_lengths(
                target, work, work.crops, poses, evidence, outside
            )
        poses, evidence = fitted_again(target, work, work.crops, poses, evidence, outside)
        poses, evidence, sibling = with_siblings(target, work, work.crops, poses, evidence, outside)
        poses, evidence = _with_texture(target, work, work.crops, poses, evidence, outside)
    inside = (~outside).nonzero()[:, 0]
    scores = evidence[inside].scores(target.score_weights(exact=work.exact))
    angle = target.pipeline.fit.same_pose_angle
    found = distinct_poses(poses[inside], scores, work.symmetries, angle=angle)
    distinct = outside.index_copy(0, inside, found)
    # Unlike another view, these started near the pose that they merged with: they are no
    # rivals.
    other = (distinct | ~repeated).nonzero()[:, 0]
    starts = starts[other]
    poses = poses[other]
    evidence = evidence[other]
    distinct = distinct[other]
    outside = outside[other]
    keep = _kept(target, work, poses, distinct, outside)
    if not bool(keep.all()):
        # Poses that merged, or whose fit is not trusted, go back to the views that they started
        # from.
        back = (~keep).nonzero()[:, 0]
        restored = starts[back]
        if work.crops is not None:
            restored = with_edge_support(target.describer, work.crops, restored)
        poses = poses.replaced(back, restored)
        evidence = evidence.replaced(back, evidence_of(target, work, restored))
    if work.crops is not None and work.item.focal_deviation:
        work, poses = with_focal_deviation(target, work, work.crops, poses, evidence, outside)
    poses = Poses.cat([poses, sibling.poses])
    evidence = Evidence.cat([evidence, sibling.evidence])
    distinct = F.pad(distinct, (0, len(sibling.poses)), value=True)
    outside = F.pad(outside, (0, len(sibling.poses)))
    siblings = len(sibling.poses)
    result = judged(target, work, poses, evidence, distinct, outside, siblings=siblings)
    result = replace(result, feature_is_hidden=sibling.feature_is_hidden)
    if work.crops is None or not work.exact:
        return result
    best = best_inside(target, evidence, outside | ~distinct)
    return compared_with_mirror_image(target, work, work.crops, poses[best], evidence[best], result)


def _rank(target: Target, item: ImageItem, query: QueryFeatures) -> Work:
    target.report_progress("ranking")
    exact = target.is_exact
    limits = None if item.prior is None else limits_of(target, item)
    ranking = _ranking(target, query, limits)
    symmetries = target.symmetries_of(exact=exact)
    crops = None
    if target.pipeline.contours:
        mask = target.object_mask(query, [item])
        crops = EdgeCrops.cut([item.image], item.box[None], target.bank.settings.margin, mask)
    frame = target.frame_of(item.box, item.size)
    return Work(
        query=query,
        ranking=ranking,
        descriptor=target.describer.descriptor(shown_in(frame, query.field)),
        crops=crops,
        keypoints=target.keypoint_matches(item, item.box) if target.uses_keypoints else None,
        item=item,
        limits=limits,
        exact=exact,
        symmetries=symmetries,
        frame=frame,
    )


def _ranking(target: Target, query: QueryFeatures, limits: Limits | None) -> Ranking:
    allowed = None if limits is None else limits.allowed()[None]
    return target.matcher.rank_together(query, allowed)


def _starts(target: Target, work: Work) -> tuple[Poses, Tensor, Tensor]:
    """Poses of the most promising distinct views, and (H,) bool: which lies outside the limits,
    the last one at most, and which repeats another one: the same view with another camera, or a
    pose that keypoints agree on, in place of the views near it.

    That outside is the best view there; it is never reported, and tells whether the limits are
    wrong.
    """
    poses = _promising(target, work) if work.starts is None else work.starts
    repeated = _are_repeated(poses.view)
    if work.crops is not None and work.exact:
        found, _ = keypoint_poses(target, work.keypoints)
        found = found if work.limits is None else found[work.limits.keeps(found)]
        if len(found):
            far = ~are_near(poses.rotation, found.rotation[0], work.symmetries)
            poses = Poses.cat([poses[far], found[torch.tensor([0])]])
            repeated = F.pad(repeated[far], (0, 1), value=True)
    outside = torch.zeros_like(repeated)
    if work.limits is None:
        return poses, outside, repeated
    assert work.ranking.outside is not None
    view = work.ranking.outside.cpu()
    if int(view) < 0:
        return poses, outside, repeated
    other = poses_of_views(target, work, view, torch.zeros(1, dtype=torch.float64))
    return (
        Poses.cat([poses, other]),
        F.pad(outside, (0, 1), value=True),
        F.pad(repeated, (0, 1)),
    )


def _promising(target: Target, work: Work) -> Poses:
    """Poses of the most promising distinct views."""
    count = least_starts(target)
    screened = count
    if work.crops is not None and work.exact:
        screened = max(target.pipeline.fit.screened_views, count)
    poses = _of_best_views(target, work, screened)
    if work.crops is None:
        return poses
    if len(poses) > count:
        poses = _screened(target, work.crops, poses, count)
    if work.frame is None:
        return poses
    whole = whole_boxes(work.item.box, work.item.size)
    beyond = [_of_best_views(target, _with_box(target, work, box), screened) for box in whole]
    return Poses.cat([poses, _screened(target, work.crops, Poses.cat(beyond), count)])


def _of_best_views(target: Target, work: Work, count: int) -> Poses:
    """Poses of the ``count`` best distinct views."""
    view, rank = best_views(work.ranking, target.bank, count=count, symmetries=work.symmetries)
    poses = poses_of_views(target, work, view, rank)
    return poses if work.limits is None else work.limits.moved_inside(poses)


def _with_box(target: Target, work: Work, box: Tensor) -> Work:
    """The photograph with another box, ranked for it."""
    query = target.matcher.query_together(work.item.image, box)
    ranking = _ranking(target, query, work.limits)
    return replace(work, item=replace(work.item, box=box), ranking=ranking)


def _screened(target: Target, crops: EdgeCrops, poses: Poses, count: int) -> Poses:
    """The ``count`` poses with the largest sum of rank and weighted edge support after a short
    fit, best first."""
    poses, support = with_quick_fit(target.describer, crops, poses)
    score = poses.rank + target.pipeline.fit.screening_weight * support
    return poses[score.argsort(descending=True, stable=True)[:count]]


def _searched(target: Target, work: Work) -> Registration:
    """The result of the paper's search, and further distinct views of the ranking, in its
    order."""
    target.report_progress("search")
    view, rank = best_views(
        work.ranking, target.bank, count=target.pipeline.hypotheses, symmetries=work.symmetries
    )
    rotation, distance = search(target.matcher, work.query, work.ranking)
    found = poses_in_box(target, work, rotation[None], distance[None], view[:1], rank[:1])
    poses = poses_of_views(target, work, view, rank).replaced(torch.tensor([0]), found)
    if work.limits is not None:
        poses = work.limits.moved_inside(poses)
    distinct = torch.ones(len(poses), dtype=torch.bool)
    by_rank = replace(work, exact=False)
    return judged(target, by_rank, poses, evidence_of(target, work, poses), distinct, ~distinct)


def _with_texture(
    target: Target, work: Work, crops: EdgeCrops, poses: Poses, evidence: Evidence, outside: Tensor
) -> tuple[Poses, Evidence]:
    """Fit the best pose to the mesh's colours as well."""
    best = best_inside(target, evidence, outside)
    fitted = fit_texture_of(target.describer, crops, poses, int(best))
    if fitted is None:
        return poses, evidence
    return with_replaced(work, poses, evidence, best, fitted, evidence_of(target, work, fitted))


def _kept(target: Target, work: Work, poses: Poses, distinct: Tensor, outside: Tensor) -> Tensor:
    """(H,) bool: poses that do not return to their views."""
    kept = distinct
    if target.pipeline.contours and not work.exact:
        # Where the contours of a similar object do not fit, the view has the smaller error.
        kept = kept & poses.fit.trustworthy
    return kept if work.limits is None else kept & (work.limits.keeps(poses) | outside)


def _are_repeated(views: Tensor) -> Tensor:
    """(H,) bool: whether a view (H,) is among those before it."""
    equal = views == views[:, None]
    return equal.tril(diagonal=-1).any(dim=1)
