"""One photograph with a box: rank views, fit the contours of the most promising, judge, report."""

from contextlib import suppress
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CurviregError
from ..fitting.edges import EdgeCrops
from ..matching import Ranking
from ..terms import QueryFeatures
from ..utils.rows import Rows
from .camera_check import with_checked_camera
from .candidates import Candidates
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
    with_short_fit,
)
from .priors import Limits
from .refits import refitted
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
    starts = _starts(target, work)
    poses = starts.poses
    if work.crops is not None:
        target.report_progress("contours")
        poses = _fitted(target, work, work.crops, poses)
    found = Candidates.of(poses, evidence_of(target, work, poses), starts.outside)
    rival = Rival(found[:0])
    if work.crops is not None and work.exact:
        found, rival = _improved(target, work, work.crops, found)
    found = _merged(target, work, found)
    # Unlike another view, these started near the pose that they merged with: they are no
    # rivals.
    other = (found.distinct | ~starts.repeated).nonzero()[:, 0]
    found = _with_views_again(target, work, found[other], starts.poses[other])
    if work.crops is not None and work.item.focal_deviation:
        work, found = with_focal_deviation(target, work, work.crops, found)
    found = Candidates.cat([found, rival.found])
    result = judged(target, work, found, siblings=len(rival.found))
    result = replace(result, feature_is_hidden=rival.feature_is_hidden)
    if work.crops is None or not work.exact:
        return result
    best = found[found.best(target.score_weights(exact=True))]
    result = compared_with_mirror_image(target, work, work.crops, best, result)
    return with_checked_camera(target, work, work.crops, best.poses, result)


def _fitted(target: Target, work: Work, crops: EdgeCrops, starts: Poses) -> Poses:
    """Fit the contours of the starts, those without a short fit after one."""
    unknown = starts.short_fit[:, 0, 0].isnan().nonzero()[:, 0]
    if len(unknown):
        fitted, _ = with_short_fit(target.describer, crops, starts[unknown])
        starts = starts.replaced(unknown, fitted)
    finish = target.pipeline.fit.finished_fits if work.starts is None else FINISHED
    if work.frame is not None:  # at the border as many poses of larger boxes compete
        finish *= 2
    return fitted_poses(target, work, crops, starts, short_fits=starts.short_fit, finish=finish)


def _improved(
    target: Target, work: Work, crops: EdgeCrops, found: Candidates
) -> tuple[Candidates, Rival]:
    """Fit the best poses further, with all that is known of the exact mesh; and the rival of the
    best one among its siblings."""
    if work.item.focal_deviation:
        found = with_fitted_focal_lengths(target, work, crops, found)
    found = refitted(target, work, crops, found)
    found, rival = with_siblings(target, work, crops, found)
    return _with_texture(target, work, crops, found), rival


def _merged(target: Target, work: Work, found: Candidates) -> Candidates:
    """Poses that end where a better one does are not distinct."""
    inside = (~found.outside).nonzero()[:, 0]
    some = found[inside]
    scores = some.evidence.scores(target.score_weights(exact=work.exact))
    angle = target.pipeline.fit.same_pose_angle
    distinct = distinct_poses(some.poses, scores, work.symmetries, angle=angle)
    return replace(found, distinct=found.distinct.index_copy(0, inside, distinct))


def _with_views_again(target: Target, work: Work, found: Candidates, starts: Poses) -> Candidates:
    """Put poses that merged, or whose fit is not trusted, back to the views that they started
    from."""
    back = (~_kept(target, work, found)).nonzero()[:, 0]
    if not len(back):
        return found
    restored = starts[back]
    if work.crops is not None:
        restored = with_edge_support(target.describer, work.crops, restored)
    return found.with_fitted(back, restored, evidence_of(target, work, restored))


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


@dataclass(frozen=True)
class Starts(Rows):
    """Poses of the most promising distinct views.

    Attributes:
        poses: H of them.
        outside: (H,) bool, which lies outside the limits, the last one at most: the best view
            there. It is never reported, and tells whether the limits are wrong.
        repeated: (H,) bool, which repeats another one: the same view with another camera, or a pose
            that keypoints agree on, in place of the views near it.
    """

    poses: Poses
    outside: Tensor
    repeated: Tensor


def _starts(target: Target, work: Work) -> Starts:
    poses = _promising(target, work) if work.starts is None else work.starts
    repeated = _are_repeated(poses.view)
    if work.crops is not None and work.exact:
        found, _ = keypoint_poses(target, work.keypoints)
        found = found if work.limits is None else found[work.limits.keeps(found)]
        if len(found):
            far = ~are_near(poses.rotation, found.rotation[0], work.symmetries)
            poses = Poses.cat([poses[far], found[torch.tensor([0])]])
            repeated = F.pad(repeated[far], (0, 1), value=True)
    starts = Starts(poses, torch.zeros_like(repeated), repeated)
    if work.limits is None:
        return starts
    assert work.ranking.outside is not None
    view = work.ranking.outside.cpu()
    if int(view) < 0:
        return starts
    other = poses_of_views(target, work, view, torch.zeros(1, dtype=torch.float64))
    return Starts.cat([starts, Starts(other, torch.tensor([True]), torch.tensor([False]))])


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
    poses, support = with_short_fit(target.describer, crops, poses)
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
    by_rank = replace(work, exact=False)
    return judged(target, by_rank, Candidates.of(poses, evidence_of(target, work, poses)))


def _with_texture(target: Target, work: Work, crops: EdgeCrops, found: Candidates) -> Candidates:
    """Fit the best pose to the mesh's colours as well."""
    best = found.best(target.score_weights(exact=True))
    fitted = fit_texture_of(target.describer, crops, found.poses, int(best))
    if fitted is None:
        return found
    return found.with_fitted(best, fitted, evidence_of(target, work, fitted), work.limits)


def _kept(target: Target, work: Work, found: Candidates) -> Tensor:
    """(H,) bool: poses that do not return to their views."""
    kept = found.distinct
    if target.pipeline.contours and not work.exact:
        # Where the contours of a similar object do not fit, the view has the smaller error.
        kept = kept & found.poses.fit.trustworthy
    return kept if work.limits is None else kept & (work.limits.keeps(found.poses) | found.outside)


def _are_repeated(views: Tensor) -> Tensor:
    """(H,) bool: whether a view (H,) is among those before it."""
    equal = views == views[:, None]
    return equal.tril(diagonal=-1).any(dim=1)
