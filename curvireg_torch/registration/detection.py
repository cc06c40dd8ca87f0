"""Detection: objects are found and registered in photographs that come without a box.

A few representative views are compared with every position of the photograph, and keypoints with
its features. The boxes that they propose are compared with all views, and the most probable ones
are registered.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..geometry.crops import box_iou, non_maximum_suppression
from ..geometry.framing import boxes_at
from ..geometry.pose_prior import PosePrior
from ..matching.detector import SAME_OBJECT_OVERLAP, Proposals
from ..terms import QueryFeatures
from ..utils.likes import CameraLike, ImagesLike
from .block import keypoint_poses
from .camera import limits_of, usual_camera
from .confidence import detection_probability, two_decimals
from .hypotheses import projected_box
from .photograph import Photograph, as_photographs, check_crop
from .result import Detection, FailedRegistration, Registration, Results
from .stages import map_photographs, register
from .target import Target

MIN_REGISTERED = 2  # Places that are registered at least, as a fitted pose tells more than its box
FOUND_CONFIDENCE = 0.1  # Confidence below which the object counts as not found


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
def detect_prepared(
    target: Target, items: Sequence[Photograph | CurviregError], *, instances: int = 1
) -> list[Results]:
    """:func:`detect` in photographs that :func:`.as_photographs` has prepared."""
    if instances < 1:
        raise InvalidInputError(f"instances: expected >= 1, got {instances}")
    found = map_photographs(
        items, lambda item, index: detect_one(target, item, index, instances=instances)
    )
    return [[one] if isinstance(one, FailedRegistration) else one for one in found]


def detect_one(target: Target, item: Photograph, index: int, *, instances: int = 1) -> Results:
    """:func:`detect` in one photograph, the ``index``-th one; its box does not matter."""
    target.report_progress("detection")
    proposals = propose(target, item)
    candidates = _register_candidates(target, item, proposals, instances)
    found = _with_proposals(candidates, proposals)
    convincing = [
        one
        for one in found
        if (1.0 if one.confidence is None else one.confidence) >= FOUND_CONFIDENCE
    ]
    return [*convincing] or [_lost(found, index)]


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
class DescribedBox:
    """A described box (4,) of a photograph, with its ``response`` and ``rival``
    (:func:`detection_probability`), and as ``score`` the probability that it shows the object."""

    box: Tensor
    response: float
    rival: float | None
    query: QueryFeatures
    score: float

    @classmethod
    def compared(
        cls,
        target: Target,
        item: Photograph,
        box: Tensor,
        response: float,
        rival: float | None,
    ) -> "DescribedBox":
        """Compare a box (4,) with all views."""
        query = target.matcher.query([item.image], box[None].float())
        allowed = None
        if item.prior is not None:
            allowed = limits_of(target, replace(item, box=box.float())).allowed()[None]
        similarity = float(target.matcher.similarity(query, allowed))
        score = detection_probability(response, similarity, rival=rival)
        return cls(box, response, rival, query, score)

    def register(self, target: Target, item: Photograph) -> "RegisteredBox":
        (result,) = register(target, [replace(item, box=self.box.float())], self.query)
        box = projected_box(target.describer, result.projection)
        return RegisteredBox(**{**vars(self), "box": box}, registration=result)


@dataclass(frozen=True, kw_only=True)
class RegisteredBox(DescribedBox):
    """One that was registered; its ``box`` (4,) is that around the pose."""

    registration: Registration

    @property
    def probability(self) -> float:
        """That the object is there, and its pose right."""
        return self.score * (
            1.0 if self.registration.confidence is None else self.registration.confidence
        )


def _register_candidates(
    target: Target, item: Photograph, proposals: Proposals, instances: int
) -> list[RegisteredBox]:
    """The most probable objects, at most ``instances``, whose boxes do not overlap; the error of
    the best if there is none."""
    candidates = []
    failed = None
    counts = proposals.responses[: proposals.by_keypoints].tolist()
    for k, (box, response) in enumerate(
        zip(proposals.boxes, proposals.responses.tolist(), strict=True)
    ):
        rival = max([0.0, *counts[:k], *counts[k + 1 :]]) if k < len(counts) else None
        try:
            candidates.append(DescribedBox.compared(target, item, box, response, rival))
        except CurviregError as error:  # such as limits on the pose that leave no view here
            failed = failed or error
    if not candidates and failed is not None:
        raise failed
    boxes = torch.stack([c.box for c in candidates])
    scores = torch.tensor([c.score for c in candidates])
    found: list[RegisteredBox] = []
    for k in non_maximum_suppression(boxes, scores, SAME_OBJECT_OVERLAP).tolist():
        if len(found) < max(instances, MIN_REGISTERED):
            _add(found, _refined(target, item, candidates[k].register(target, item)))
    return sorted(found, key=lambda one: one.probability, reverse=True)[:instances]


def _refined(target: Target, item: Photograph, found: RegisteredBox) -> RegisteredBox:
    """The more certain one of a registration and of that of the box around its pose."""
    try:
        candidate = DescribedBox.compared(target, item, found.box, found.response, found.rival)
    # the projected mesh lies outside the photograph: nothing there supports the pose
    except InvalidInputError:
        return replace(found, score=0.0)
    return found if candidate.score <= found.score else candidate.register(target, item)


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
