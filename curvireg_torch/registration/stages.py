"""A registration, stage by stage, each for a block of photographs at once: describe, rank, start,
screen, fit, refit, judge."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..errors import CurviregError
from ..evidence import EvidenceWeights
from ..fitting.edges import EdgeCrops
from ..geometry.framing import hidden_boxes, whole_boxes
from ..matching import Ranking
from ..matching.search import search
from ..terms import QueryFeatures
from ..utils.precision import exact_convolutions
from ..utils.segments import order_within, place_within
from .block import (
    Block,
    Limits,
    block_size,
    described,
    fitted_poses,
    keypoint_poses,
    least_starts,
    poses_of_best_views,
    poses_of_views,
    refitted,
    with_evidence,
)
from .camera import (
    FINISHED,
    limits_of,
    with_checked_cameras,
    with_fitted_focal_lengths,
    with_focal_deviation,
    with_possible_cameras,
)
from .confidence import are_near
from .doubts import (
    MIRROR_WARNING,
    compared_with_input,
    compared_with_mirror_image,
    with_siblings,
)
from .hypotheses import (
    Hypotheses,
    are_repeated,
    common_score,
    distinct_poses,
    fit_texture_of,
    projected_box,
    with_edge_support,
    with_short_fit,
)
from .judging import best_of_meshes, judged, with_determined_turns
from .photograph import Photograph, check_crop
from .result import FailedRegistration, Registration, Results
from .target import Target

Items = Sequence[Photograph | CurviregError]
Result = Registration | CurviregError

# Overlap (IoU) with a box that was tried, from which the box around a pose is not: of doubtful
# answers; of reliable ones, for the best pose and the second. On 60 generated photographs boxes
# drawn by hand overlapped that around the best pose by at least 0.86
SAME_BOX_OVERLAP = 0.98
RELIABLE_OVERLAPS = (0.85, 0.0)
# Confidences below it, or above 1 minus it, do not tell which of two boxes is right
LEAST_CONFIDENCE = 0.005
VIEWS_OF_HIDDEN = 4  # best views that are tried in each box of an object behind an occluder


def blocks_of(items: Items, device: str) -> Iterator[tuple[int, Items]]:
    """Blocks of photographs on a kind of device, each with the index of its first one. Items are
    read on demand, so that few are in memory."""
    size = block_size(device)
    for first in range(0, len(items), size):
        yield first, [items[k] for k in range(first, min(first + size, len(items)))]


def _register_block(target: Target, items: Items, first: int) -> Results:
    """Register a few photographs in their boxes; the ``first`` one's index is that of the
    caller."""
    results: Results = []
    registered = register_boxes(target, items)
    for index, (item, result) in enumerate(zip(items, registered, strict=True), first):
        if isinstance(item, CurviregError):
            results.append(FailedRegistration(item))
        elif isinstance(result, CurviregError):
            results.append(failure(result, index))
        else:
            results.append(result)
    return results


def register_photographs(
    target: Target,
    items: Items,
    others: Sequence[Target] = (),
    *,
    detect: Callable[[Target, Items, int], Results] | None = None,
) -> Results:
    """Register photographs in blocks, each to the best of the target and ``others``; one that
    cannot be registered fails alone. They are registered in their boxes, which are corrected, or,
    with ``detect(target, items, first)``, where that finds the object in a few photographs, the
    first of which has the index ``first``."""
    results: Results = []
    meshes = (target, *others)
    in_block = detect or _register_block
    with exact_convolutions():
        for first, some in blocks_of(items, target.bank.device.type):
            of_meshes = [in_block(mesh, some, first) for mesh in meshes]
            best = _best_of_each(of_meshes, meshes, some)
            if detect is None:
                corrected = _with_best_corrected(of_meshes, best, meshes, some)
                best = _best_of_each(corrected, meshes, some)
                best = [compared_with_input(meshes, *pair) for pair in zip(some, best, strict=True)]
            results += best
    return results


def _best_of_each(of_meshes: Sequence[Results], meshes: Sequence[Target], items: Items) -> Results:
    """The best of the results of several meshes for each photograph."""
    return [
        best_of_meshes(found, meshes, item if isinstance(item, Photograph) else None)
        for item, found in zip(items, zip(*of_meshes, strict=True), strict=True)
    ]


def _with_best_corrected(
    of_meshes: Sequence[Results], best: Results, meshes: Sequence[Target], items: Items
) -> list[Results]:
    """The results of several meshes, in corrected boxes where a mesh is the best one of a
    photograph: with wrong meshes nearly all answers are doubtful. Another box does not make a
    mirrored mesh the right one."""
    corrected = []
    for number, (mesh, results) in enumerate(zip(meshes, of_meshes, strict=True)):
        chosen = {
            k: result
            for k, (result, one) in enumerate(zip(results, best, strict=True))
            if isinstance(result, Registration)
            and isinstance(one, Registration)
            and one.mesh_index == number
            and MIRROR_WARNING not in result.warnings
        }
        again = _in_corrected_boxes(mesh, items, chosen)
        corrected.append([again.get(k, result) for k, result in enumerate(results)])
    return corrected


def failure(error: CurviregError, index: int) -> FailedRegistration:
    """Why the photograph with this index has no pose."""
    return FailedRegistration(error.with_subject("").of_image(index))


def _in_corrected_boxes(
    target: Target, items: Items, first: Mapping[int, Registration]
) -> dict[int, Registration]:
    """The ``first`` results of some photographs, by their numbers. One that is doubtful, or whose
    box is far from that around its pose, is registered again in the latter, and if it is doubtful,
    also in that around the second pose. What agrees best with the photograph stands."""
    best = dict(first)
    again: list[tuple[int, Photograph]] = []
    for k, result in first.items():
        tried = [item for item in (items[k],) if isinstance(item, Photograph)]
        for rank, reliable_overlap in enumerate(RELIABLE_OVERLAPS):
            overlap = SAME_BOX_OVERLAP if result.is_doubtful else reliable_overlap
            other_box = _in_box_of_pose(target, tried, result, rank, overlap)
            if other_box is not None:
                again.append((k, other_box))
                tried.append(other_box)
    others = register_boxes(target, [item for _, item in again])
    weights = target.score_weights(exact=True)
    for (k, item), other in zip(again, others, strict=True):
        if not isinstance(other, Registration):
            continue
        if _agreement(other, weights) > _agreement(best[k], weights):
            best[k] = replace(other, corrected_box=item.box.double())
    return best


def _agreement(result: Registration, weights: EvidenceWeights) -> float:
    """How well a result agrees with its photograph, comparable with those in other boxes."""
    agreement = common_score(result.hypotheses[0], weights)
    if result.confidence is None:
        return agreement
    log_odds = torch.tensor(result.confidence).logit(LEAST_CONFIDENCE)
    return agreement + float(log_odds)


def _in_box_of_pose(
    target: Target, tried: Sequence[Photograph], result: Registration, rank: int, overlap: float
) -> Photograph | None:
    """The photograph with the box around the hypothesis of this ``rank``, if that overlaps the
    boxes that were ``tried`` by less than ``overlap`` (IoU)."""
    # Without a camera, poses are derived from their boxes.
    if not (target.pipeline.box_jitter and target.pipeline.contours and result.camera is not None):
        return None
    # the pose's box is that of the whole object
    if target.boxes_are_visible or rank >= len(result.hypotheses):
        return None
    item = tried[0]
    box = projected_box(target.describer, result.hypotheses[rank].projection)
    # in a frame and without one, similarities mean different things
    alike = target.has_frame(item.box, item.size) == target.has_frame(box, item.size)
    if alike and all(other.overlap(box) < overlap for other in tried):
        return replace(item, box=box.float())
    return None


def register_boxes(target: Target, items: Items) -> list[Result]:
    """Register photographs in their boxes. Those with a mask and those without are blocks of their
    own: a mask weights the edges of all."""
    found: dict[int, Result] = {
        k: item for k, item in enumerate(items) if isinstance(item, CurviregError)
    }
    for has_mask in (False, True):
        alike = {
            k: item
            for k, item in enumerate(items)
            if isinstance(item, Photograph) and (item.mask is not None) == has_mask
        }
        together = _register_alike(target, list(alike.values()))
        found.update(zip(alike, together, strict=True))
    return [found[k] for k in range(len(items))]


def _register_alike(target: Target, items: Sequence[Photograph]) -> list[Result]:
    """Register photographs together; where that fails, each alone, so that an error is that of its
    own photograph."""
    if not items:
        return []
    try:
        query = describe(target, items)
        return list(register(target, items, query))
    except CurviregError as error:
        if len(items) == 1:
            return [error]
    shown = [_shown(target, item) for item in items]
    usable = [item for item in shown if isinstance(item, Photograph)]
    if len(usable) == len(items):
        return [_register_alike(target, [item])[0] for item in items]
    registered = iter(_register_alike(target, usable))
    return [next(registered) if isinstance(one, Photograph) else one for one in shown]


def _shown(target: Target, item: Photograph) -> Photograph | CurviregError:
    """A photograph whose box can be described, or why it cannot."""
    try:
        describe(target, [item])
    except CurviregError as error:
        return error
    return item


@torch.no_grad()
def register(
    target: Target, photographs: Sequence[Photograph], query: QueryFeatures
) -> list[Registration]:
    """Register photographs: rank, start, screen, fit, refit, judge.

    Args:
        target: the object.
        photographs: P of them.
        query: the same, cropped and described by the matcher.
    """
    block = rank(target, photographs, query)
    starts = None
    if block.exact:
        block, starts = with_possible_cameras(target, block)
    if target.pipeline.search:
        return _searched(target, block)
    begun = start(target, block, starts)
    poses = begun
    if block.crops is not None:
        target.report_progress("contours")
        poses = fit(target, block, block.crops, begun)
    poses = with_evidence(target, block, poses)
    rivals = poses[:0]
    feature_is_hidden = [False] * len(block)
    if block.crops is not None and block.exact:
        poses = refit(target, block, block.crops, poses)
        poses, rivals, feature_is_hidden = with_siblings(target, block, block.crops, poses)
        poses = _with_texture(target, block, block.crops, poses)
    poses = _merged(target, block, poses)
    needed = _needed(block, poses, begun).nonzero()[:, 0]
    poses = _with_views_again(target, block, poses[needed], begun[needed])
    if block.crops is not None:
        block, poses = with_focal_deviation(target, block, block.crops, poses)
    compared = Hypotheses.cat([poses, rivals])
    if block.crops is not None and block.exact:
        compared = with_determined_turns(target, block, block.crops, compared)
    results = judge(target, block, compared, feature_is_hidden)
    if block.crops is None or not block.exact:
        return results
    best = compared[compared.best(target.score_weights(exact=True))]
    results = compared_with_mirror_image(target, block, block.crops, best, results)
    return with_checked_cameras(target, block, block.crops, best, results)


def describe(target: Target, items: Sequence[Photograph]) -> QueryFeatures:
    """Crop and describe the boxes of photographs; one that shows nothing is refused."""
    boxes = torch.stack([item.box for item in items])
    query = target.matcher.query([item.image for item in items], boxes)
    for crop in query.crops:
        check_crop(crop)
    return query


def rank(target: Target, photographs: Sequence[Photograph], query: QueryFeatures) -> Block:
    """Compare the views of the bank with photographs."""
    for _ in photographs:
        target.report_progress("ranking")
    exact = target.is_exact
    limits = [None if item.prior is None else limits_of(target, item) for item in photographs]
    rankings = _rankings(target, query, limits)
    seen = described(target, photographs, query, rankings, contours=target.pipeline.contours)
    return Block(
        **vars(seen),
        photographs=photographs,
        limits=limits,
        exact=exact,
        symmetries=target.symmetries_of(exact=exact),
        tried_cameras=torch.zeros(len(photographs), dtype=torch.bool),
    )


def allowed_views(target: Target, limits: Sequence[Limits | None]) -> Tensor | None:
    """(P, N) bool: the views of the bank that the limits of each photograph allow; None if no
    photograph has limits."""
    if all(one is None for one in limits):
        return None
    everything = torch.ones(len(target.bank), dtype=torch.bool)
    return torch.stack([everything if one is None else one.allowed() for one in limits])


def _rankings(
    target: Target, query: QueryFeatures, limits: Sequence[Limits | None]
) -> list[Ranking]:
    """The ranking of each photograph."""
    rankings = target.matcher.rank(query, allowed_views(target, limits)).split()
    return [
        replace(ranking, allowed=None, outside=None) if one is None else ranking
        for ranking, one in zip(rankings, limits, strict=True)
    ]


def start(target: Target, block: Block, starts: Hypotheses | None) -> Hypotheses:
    """Poses that fits begin from, those of each photograph together: the most promising distinct
    views, ``starts`` of several cameras, poses on which keypoints agree, and the best view outside
    the limits."""
    parts = [_promising(target, block)]
    if starts is not None:
        parts.append(starts)
    poses = _grouped(Hypotheses.cat(parts))
    poses = replace(poses, is_repeated=are_repeated(poses.view, poses.photograph))
    if block.crops is not None and block.exact:
        poses = _with_keypoints(target, block, poses)
    outside = {
        p: int(ranking.outside)
        for p, ranking in enumerate(block.rankings)
        if block.limits[p] is not None and ranking.outside is not None
    }
    places = [p for p, view in outside.items() if view >= 0]
    if not places:
        return poses
    view = torch.tensor([outside[p] for p in places])
    no_rank = torch.zeros(len(places), dtype=torch.float64)
    other = poses_of_views(target, block, view, no_rank, torch.tensor(places))
    other = replace(other, is_outside=torch.ones_like(other.is_outside))
    return _grouped(Hypotheses.cat([poses, other]))


def _grouped(poses: Hypotheses) -> Hypotheses:
    """Poses in the order of their photographs."""
    return poses[poses.photograph.argsort(stable=True)]


def _promising(target: Target, block: Block) -> Hypotheses:
    """Poses of the most promising distinct views of photographs whose camera is known."""
    count = least_starts(target)
    screened = count
    if block.crops is not None and block.exact:
        screened = max(target.pipeline.fit.screened_views, count)
    places = (~block.tried_cameras).nonzero()[:, 0].tolist()
    rankings = [block.rankings[p] for p in places]
    boxes = block.boxes
    counts = [screened] * len(places)
    poses = poses_of_best_views(target, block, rankings, places, boxes[places], counts)
    if block.crops is None:
        return poses
    photographs = torch.bincount(poses.photograph, minlength=len(block))
    few = (photographs <= count)[poses.photograph]
    parts = [poses[few], _screened(target, block.crops, poses[~few], count)]
    beyond = _in_larger_boxes(target, block, screened)
    if beyond is not None:
        parts.append(_screened(target, block.crops, beyond, count))
    return Hypotheses.cat(parts)


def _in_larger_boxes(target: Target, block: Block, count: int) -> Hypotheses | None:
    """Poses of the best views in the larger boxes that whole objects may have: those of photographs
    whose border cuts theirs, and of visible parts."""
    larger = [
        (p, box, views)
        for p, item in enumerate(block.photographs)
        if block.frames[p] is not None and not bool(block.tried_cameras[p])
        for box, views in _larger_boxes(target, item, count)
    ]
    if not larger:
        return None
    places = [p for p, _, _ in larger]
    boxes = torch.stack([box for _, box, _ in larger])
    counts = [views for _, _, views in larger]
    query = target.matcher.query([block.photographs[p].image for p in places], boxes)
    rankings = _rankings(target, query, [block.limits[p] for p in places])
    return poses_of_best_views(target, block, rankings, places, boxes, counts)


def _larger_boxes(target: Target, item: Photograph, count: int) -> list[tuple[Tensor, int]]:
    """Boxes that the whole object may have which a photograph shows a part of, and how many views
    are tried in each: ``count`` beyond the border, and fewer in the many behind an occluder."""
    boxes = [(box, count) for box in whole_boxes(item.box, item.size)]
    if target.boxes_are_visible:
        boxes += [(box, VIEWS_OF_HIDDEN) for box in hidden_boxes(item.box)]
    return boxes


def _screened(target: Target, crops: EdgeCrops, poses: Hypotheses, count: int) -> Hypotheses:
    """The ``count`` poses of each photograph with the largest sum of rank and weighted edge support
    after a short fit, best first."""
    if not len(poses):
        return poses
    poses, support = with_short_fit(target.describer, crops, poses)
    score = poses.rank + target.pipeline.fit.screening_weight * support
    order = order_within(score, poses.photograph)
    return poses[order[place_within(score, poses.photograph)[order] < count]]


def _with_keypoints(target: Target, block: Block, poses: Hypotheses) -> Hypotheses:
    """The best pose on which keypoints agree in place of the views near it."""
    agreed = []
    dropped = torch.zeros(len(poses), dtype=torch.bool)
    for p, (matches, limits) in enumerate(zip(block.keypoints, block.limits, strict=True)):
        if matches is None:
            continue
        found, _ = keypoint_poses(target, matches)
        found = found if limits is None else found[limits.keeps(found)]
        if len(found):
            rows = poses.of(p)
            near = are_near(poses.rotation[rows], found.rotation[0], block.symmetries)
            dropped[rows[near]] = True
            where = torch.tensor([p])
            agreed.append(replace(found[:1], photograph=where, is_repeated=torch.tensor([True])))
    return _grouped(Hypotheses.cat([poses[~dropped], *agreed]))


def fit(target: Target, block: Block, crops: EdgeCrops, starts: Hypotheses) -> Hypotheses:
    """Fit the contours of the starts, those without a short fit after one."""
    unknown = starts.short_fit[:, 0, 0].isnan().nonzero()[:, 0]
    if len(unknown):
        fitted, _ = with_short_fit(target.describer, crops, starts[unknown])
        starts = starts.replaced(unknown, fitted)
    finish = torch.where(block.tried_cameras, FINISHED, target.pipeline.fit.finished_fits)
    # in a frame as many poses of larger boxes compete
    in_frame = torch.tensor([frame is not None for frame in block.frames])
    finish = torch.where(in_frame, 2 * finish, finish)[starts.photograph]
    return fitted_poses(target, block, crops, starts, short_fits=starts.short_fit, finish=finish)


def refit(target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses) -> Hypotheses:
    """Fit the best poses and their rivals further, with their focal lengths where these are
    uncertain."""
    poses = with_fitted_focal_lengths(target, block, crops, poses)
    return refitted(target, block, crops, poses)


def _with_texture(target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses) -> Hypotheses:
    """Fit the best pose of each photograph to the mesh's colours as well."""
    for row in poses.best(target.score_weights(exact=True)).split(1):
        fitted = fit_texture_of(target.describer, crops, poses[row])
        if fitted is not None and bool(block.keeps(fitted)):
            poses = poses.with_poses(row, with_evidence(target, block, fitted))
    return poses


def _merged(target: Target, block: Block, poses: Hypotheses) -> Hypotheses:
    """Poses that end where a better one of the photograph does are not distinct."""
    is_distinct = poses.is_distinct.clone()
    scores = poses.evidence.scores(target.score_weights(exact=block.exact))
    angle = target.pipeline.fit.same_pose_angle
    for p in range(len(block)):
        rows = poses.of(p)
        rows = rows[~poses.is_outside[rows]]
        is_distinct[rows] = distinct_poses(
            poses.rotation[rows], scores[rows], block.symmetries, angle=angle
        )
    return replace(poses, is_distinct=is_distinct)


def _needed(block: Block, poses: Hypotheses, starts: Hypotheses) -> Tensor:
    """(N,) bool: the poses that did not merge with a better one; where one alone is left of a
    photograph, also those that merged with it, whose views tell how clear it is. Repeated starts
    do not: they began near it."""
    is_left = poses.is_distinct & ~poses.is_outside
    left = torch.bincount(poses.photograph[is_left], minlength=len(block))
    is_alone = (left <= 1)[poses.photograph]
    return poses.is_distinct | (is_alone & ~starts.is_repeated)


def _with_views_again(
    target: Target, block: Block, poses: Hypotheses, starts: Hypotheses
) -> Hypotheses:
    """Put poses that merged, or whose fit is not trusted, back to the views that they started
    from."""
    back = (~_kept(target, block, poses)).nonzero()[:, 0]
    if not len(back):
        return poses
    restored = starts[back]
    if block.crops is not None:
        restored = with_edge_support(target.describer, block.crops, restored)
    return poses.with_poses(back, with_evidence(target, block, restored))


def _kept(target: Target, block: Block, poses: Hypotheses) -> Tensor:
    """(N,) bool: poses that do not return to their views."""
    kept = poses.is_distinct
    if target.pipeline.contours and not block.exact:
        # Where the contours of a similar object do not fit, the view has the smaller error.
        kept = kept & poses.fit.trustworthy
    return kept & (block.keeps(poses) | poses.is_outside)


def judge(
    target: Target, block: Block, poses: Hypotheses, feature_is_hidden: Sequence[bool]
) -> list[Registration]:
    """The answer in each photograph."""
    results = []
    for p, is_hidden in enumerate(feature_is_hidden):
        result = judged(target, block, p, poses[poses.of(p)])
        results.append(replace(result, feature_is_hidden=is_hidden))
    return results


def _searched(target: Target, block: Block) -> list[Registration]:
    """The results of the paper's search, and further distinct views of the rankings, in their
    order."""
    target.report_progress("search")
    block = replace(block, exact=False)
    results = []
    for p, (ranking, query) in enumerate(zip(block.rankings, block.query.split(), strict=True)):
        count = target.pipeline.hypotheses
        poses = poses_of_best_views(target, block, [ranking], [p], block.boxes[p : p + 1], [count])
        rotation, distance = search(target.matcher, query, ranking)
        found = Hypotheses.in_boxes(
            target.describer,
            block.boxes[p : p + 1],
            block.cameras[p : p + 1],
            rotation[None],
            distance[None],
            poses.view[:1],
            poses.rank[:1],
            torch.tensor([p]),
        )
        poses = block.moved_inside(poses.replaced(torch.tensor([0]), found))
        results.append(judged(target, block, p, with_evidence(target, block, poses)))
    return results
