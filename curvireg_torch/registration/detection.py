"""Detection: objects are found and registered in photographs that come without a box.

A few representative views are compared with every position of the photograph, and keypoints with
its features. The boxes that they propose are compared with all views, and the most probable ones
are registered.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..geometry.crops import box_iou, non_maximum_suppression
from ..geometry.framing import boxes_at
from ..geometry.pose_prior import PosePrior
from ..matching.detector import SAME_OBJECT_OVERLAP, Proposals
from ..utils.likes import CameraLike, ImagesLike
from ..utils.precision import exact_convolutions, full_precision
from .block import keypoint_poses
from .camera import limits_of, usual_camera
from .confidence import detection_probability, two_decimals
from .hypotheses import projected_box
from .photograph import Photograph, as_photographs, check_crop
from .result import Detection, FailedRegistration, Registration, Results
from .stages import Items, allowed_views, blocks_of, failure, register_boxes
from .target import Target

MIN_REGISTERED = 2  # Places that are registered at least, as a fitted pose tells more than its box
FOUND_CONFIDENCE = 0.1  # Confidence below which the object counts as not found
SCORED_AT_A_TIME = 64  # Boxes whose crops are in memory together


@torch.no_grad()
def detect(
    target: Target,
    images: ImagesLike,
    camera_matrices: CameraLike | None = None,
    *,
    instances: int = 1,
    prior: PosePrior | Sequence[PosePrior | None] | None = None,
) -> list[Results]:
    """Find and register objects in whole photographs, the most probable pose first.

    All proposals are compared with the views of the bank, which yields the probability that each
    shows the object. The most probable ones are registered, two at least, and the box around each
    pose too where it is more probable.

    Args:
        target: the object, a :class:`.Registrar`.
        images, camera_matrices, prior: see :class:`Registrar`.
        instances: largest number of objects in each photograph.

    Returns:
        For each photograph one to ``instances`` registrations with their ``detection``; or one that
        failed, with :class:`LostObjectError` where no place is convincing.

    Raises:
        InvalidInputError: not as many cameras or priors as images, or ``instances`` < 1.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=45, elevations=[20])
        >>> how = {"pipeline": cr.pipeline.PRESETS["fast"], "image_size": 64, "progress": False}
        >>> bank = cr.ViewBank.build(scene.mesh, views, **how)
        >>> (found,) = detect(cr.Registrar(bank), [scene.image], scene.camera_matrix)
        >>> len(found) >= 1
        True
    """
    items = as_photographs(images, None, camera_matrices, prior)
    return detect_prepared(target, items, instances=instances)


@torch.no_grad()
@full_precision()
def detect_prepared(target: Target, items: Items, *, instances: int = 1) -> list[Results]:
    """:func:`detect` in photographs that :func:`.as_photographs` has prepared."""
    if instances < 1:
        raise InvalidInputError(f"instances: expected >= 1, got {instances}")
    found: list[Results] = []
    with exact_convolutions():
        for first, some in blocks_of(items, target.bank.device.type):
            found += detect_block(target, some, first, instances=instances)
    return found


def detect_block(
    target: Target,
    items: Items,
    first: int,
    *,
    instances: int = 1,
) -> list[Results]:
    """:func:`detect` in a few photographs, whose boxes do not matter; the ``first`` one's index is
    that of the caller."""
    results: dict[int, Results] = {}
    photographs: dict[int, Photograph] = {}
    for p, item in enumerate(items):
        if isinstance(item, Photograph):
            photographs[p] = item
        else:
            results[p] = [FailedRegistration(item)]
    proposals: dict[int, Proposals] = {}
    found: dict[int, list[RegisteredBox] | CurviregError] = {}
    for p, item in photographs.items():
        target.report_progress("detection")
        try:
            proposals[p] = propose(target, item)
        except CurviregError as error:
            found[p] = error
    found |= _register_candidates(target, photographs, proposals, instances)
    for p, candidates in found.items():
        if isinstance(candidates, CurviregError):
            results[p] = [failure(candidates, first + p)]
            continue
        registered = _with_proposals(candidates, proposals[p])
        convincing = [
            one
            for one in registered
            if (1.0 if one.confidence is None else one.confidence) >= FOUND_CONFIDENCE
        ]
        results[p] = [*convincing] or [_lost(registered, first + p)]
    return [results[p] for p in range(len(items))]


def propose(target: Target, item: Photograph) -> "Proposals":
    """Boxes in which a photograph may show the object: those around poses on which keypoints of its
    print agree, their number being the response, and those of the detector."""
    extremes = torch.stack(
        [item.image.flatten(1).amin(dim=1), item.image.flatten(1).amax(dim=1)], dim=1
    )
    check_crop(extremes.float() / 255.0 if extremes.dtype == torch.uint8 else extremes)
    distance = allowed = None
    poses, count = keypoint_poses(target, target.keypoint_matches(item))
    if item.prior is not None:
        distance = item.prior.distance
        allowed = _allowed_views(target, item)
        # sizes do not limit an unknown camera
        distance = None if item.camera is None else distance
        kept = limits_of(target, item).keeps(poses)
        poses = poses[kept]
        count = count[kept]
    focal = None if item.camera is None else float(item.K[0, 0])
    others = target.detector(item.image, focal=focal, distance=distance, allowed=allowed)
    boxes, visible = boxes_at(target.describer.hull, poses.T, poses.cameras, item.size)
    first = boxes[visible].to(others.boxes), count[visible], poses.view[visible]
    pairs = zip(first, (others.boxes, others.responses, others.views), strict=True)
    boxes, responses, views = (torch.cat(pair) for pair in pairs)
    proposals = Proposals(boxes, responses, views, by_keypoints=int(visible.sum()))
    if not len(proposals.boxes):
        raise InvalidInputError(
            "nothing of such a size fits into the photograph; give other distances, or the box"
        )
    return proposals


def _lost(found: Sequence[Registration], index: int) -> FailedRegistration:
    """The answer where no place is convincing: the most likely one, without its pose."""
    best = max(found, key=lambda one: one.confidence or 0.0)
    assert best.detection is not None
    box = " ".join(f"{v:.0f}" for v in best.detection.box.tolist())
    place = f"at the most likely place, box {box}"
    seen = f"the object is seen with a probability of {two_decimals(best.confidence or 0.0)}"
    error = LostObjectError(f"not found: {place}, {seen}; give a box", images=(index,))
    error.detection = best.detection
    return FailedRegistration(error)


def _allowed_views(target: Target, item: Photograph) -> Tensor:
    """(N,) bool: views of the bank that the prior does not exclude everywhere in the photograph,
    which is the box."""
    off_centre = 0.0
    if item.camera is None and target.is_exact:
        item = item.by(usual_camera(item.size))
    if item.camera is not None:
        x0, y0, x1, y1 = item.box.double().tolist()
        points = torch.tensor(
            [((x0 + x1) / 2, (y0 + y1) / 2, 1), (x0, y0, 1), (x1, y0, 1), (x0, y1, 1), (x1, y1, 1)]
        )
        rays = F.normalize(torch.linalg.solve(item.K, points.double().T), dim=0)
        off_centre = float(
            torch.rad2deg(torch.acos((rays[:, :1] * rays[:, 1:]).sum(dim=0).clamp(-1, 1).min()))
        )
    return limits_of(target, item).allowed(off_centre=off_centre)


@dataclass(frozen=True)
class ScoredBox:
    """A box (4,) of the ``photograph``-th photograph, with its ``response`` and ``rival``
    (:func:`detection_probability`), and as ``score`` the probability that it shows the object."""

    photograph: int
    box: Tensor
    response: float
    rival: float | None
    score: float = 0.0


@dataclass(frozen=True, kw_only=True)
class RegisteredBox(ScoredBox):
    """One that was registered; its ``box`` (4,) is that around the pose."""

    registration: Registration

    @property
    def probability(self) -> float:
        """That the object is there, and its pose right."""
        return self.score * (
            1.0 if self.registration.confidence is None else self.registration.confidence
        )


def _register_candidates(
    target: Target,
    photographs: Mapping[int, Photograph],
    proposals: Mapping[int, Proposals],
    instances: int,
) -> dict[int, list[RegisteredBox] | CurviregError]:
    """For each photograph with proposals the most probable objects, at most ``instances``, whose
    boxes do not overlap; the error of the best if there is none."""
    boxes = [box for p, one in proposals.items() for box in _boxes_of(p, one)]
    of_photographs: dict[int, list[ScoredBox]] = {p: [] for p in proposals}
    errors: dict[int, CurviregError] = {}
    for box, one in zip(boxes, _scored(target, photographs, boxes), strict=True):
        if isinstance(one, ScoredBox):
            of_photographs[box.photograph].append(one)
        else:  # such as limits on the pose that leave no view in a box
            errors.setdefault(box.photograph, one)
    waiting = {p: _best_apart(some) for p, some in of_photographs.items()}
    found: dict[int, list[RegisteredBox]] = {p: [] for p in proposals}
    wanted = max(instances, MIN_REGISTERED)
    while chosen := [box for p, some in waiting.items() for box in some[: wanted - len(found[p])]]:
        for p in waiting:
            waiting[p] = waiting[p][wanted - len(found[p]) :]
        registered = _registered(target, photographs, chosen)
        good = [one for one in registered if isinstance(one, RegisteredBox)]
        for box, one in zip(chosen, registered, strict=True):
            if isinstance(one, CurviregError):
                errors.setdefault(box.photograph, one)
        for one in _refined(target, photographs, good):
            _add(found[one.photograph], one)
    best_first = {
        p: sorted(some, key=lambda one: one.probability, reverse=True)[:instances]
        for p, some in found.items()
    }
    return {p: some or errors[p] for p, some in best_first.items()}


def _boxes_of(photograph: int, proposals: Proposals) -> list[ScoredBox]:
    """The proposals of a photograph, not yet scored."""
    counts = proposals.responses[: proposals.by_keypoints].tolist()
    boxes = []
    for k, (box, response) in enumerate(
        zip(proposals.boxes, proposals.responses.tolist(), strict=True)
    ):
        rival = max([0.0, *counts[:k], *counts[k + 1 :]]) if k < len(counts) else None
        boxes.append(ScoredBox(photograph, box, response, rival))
    return boxes


def _best_apart(boxes: Sequence[ScoredBox]) -> list[ScoredBox]:
    """The boxes, best first, that do not overlap a better one."""
    if not boxes:
        return []
    scores = torch.tensor([one.score for one in boxes])
    where = torch.stack([one.box for one in boxes])
    kept = non_maximum_suppression(where, scores, SAME_OBJECT_OVERLAP)
    return [boxes[k] for k in kept.tolist()]


Scored = TypeVar("Scored", bound=ScoredBox)


def _scored(
    target: Target,
    photographs: Mapping[int, Photograph],
    boxes: Sequence[Scored],
    at_a_time: int = SCORED_AT_A_TIME,
) -> list[Scored | CurviregError]:
    """Boxes with their scores: all views are compared with each. Where that fails of some together,
    each is scored alone."""
    found: list[Scored | CurviregError] = []
    for k in range(0, len(boxes), at_a_time):
        some = boxes[k : k + at_a_time]
        items = [replace(photographs[one.photograph], box=one.box.float()) for one in some]
        try:
            limits = [None if item.prior is None else limits_of(target, item) for item in items]
            images = [item.image for item in items]
            query = target.matcher.query(images, torch.stack([item.box for item in items]))
            similarities = target.matcher.similarity(query, allowed_views(target, limits)).tolist()
        except CurviregError as error:
            alone = at_a_time == 1
            found += [error] if alone else _scored(target, photographs, some, at_a_time=1)
            continue
        for one, similarity in zip(some, similarities, strict=True):
            probability = detection_probability(one.response, similarity, rival=one.rival)
            found.append(replace(one, score=probability))
    return found


def _registered(
    target: Target, photographs: Mapping[int, Photograph], boxes: Sequence[ScoredBox]
) -> list[RegisteredBox | CurviregError]:
    """The registrations in boxes, with the boxes around their poses."""
    items = [replace(photographs[one.photograph], box=one.box.float()) for one in boxes]
    found: list[RegisteredBox | CurviregError] = []
    for first, some in blocks_of(items, target.bank.device.type):
        results = register_boxes(target, some)
        for one, result in zip(boxes[first:], results, strict=False):
            if isinstance(result, CurviregError):
                found.append(result)
                continue
            box = projected_box(target.describer, result.projection)
            found.append(RegisteredBox(**{**vars(one), "box": box, "registration": result}))
    return found


def _refined(
    target: Target, photographs: Mapping[int, Photograph], found: Sequence[RegisteredBox]
) -> list[RegisteredBox]:
    """The more certain ones of registrations and of those of the boxes around their poses."""
    best = list(found)
    again: dict[int, RegisteredBox] = {}
    for k, candidate in enumerate(_scored(target, photographs, found)):
        if isinstance(candidate, CurviregError):
            # the projected mesh lies outside the photograph: nothing there supports the pose
            best[k] = replace(found[k], score=0.0)
        elif candidate.score > found[k].score:
            again[k] = candidate
    for k, other in zip(again, _registered(target, photographs, list(again.values())), strict=True):
        if isinstance(other, RegisteredBox):
            best[k] = other
    return best


def _add(found: list[RegisteredBox], new: RegisteredBox) -> None:
    """Add ``new``. Of those whose boxes overlap the most certain is kept: proposals may lead to the
    same object."""
    overlap = box_iou(new.box[None], torch.stack([new.box, *(one.box for one in found)]))[
        0, 1:
    ].tolist()
    same = [one for one, iou in zip(found, overlap, strict=True) if iou > SAME_OBJECT_OVERLAP]
    if all(new.score > one.score for one in same):
        found[:] = [one for one in found if not any(one is other for other in same)]
        found.append(new)


def _with_proposals(found: list[RegisteredBox], proposals: Proposals) -> list[Registration]:
    """Registrations with all proposals, their own boxes first, and the score as a factor of their
    probabilities."""
    boxes = torch.cat([torch.stack([one.box for one in found]), proposals.boxes.double()])
    responses = torch.cat([torch.tensor([one.response for one in found]), proposals.responses])
    # in their present order
    kept = non_maximum_suppression(boxes, -torch.arange(len(boxes)), SAME_OBJECT_OVERLAP)
    results = []
    for one in found:
        detection = Detection(one.box, one.score, one.response, boxes[kept], responses[kept])
        results.append(replace(one.registration.scaled(one.score), detection=detection))
    return results
