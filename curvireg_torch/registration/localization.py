"""Localization: objects are registered in photographs that come without a box."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CurviregError, InvalidInputError
from ..geometry.crops import box_iou, non_maximum_suppression
from ..geometry.pose_prior import PosePrior
from ..matching import Ranking
from ..terms import QueryFeatures
from .confidence import presence, presence_features
from .correction import projected_box
from .estimator import PoseEstimator
from .inputs import ImageItem, check_crop, image_items
from .locator import Located
from .locator.locator import OVERLAP
from .priors import BatchPriors
from .results import FailedRegistration, Localization, Registration

__all__ = ["ScoredCandidates", "localize"]

_Result = Registration | FailedRegistration


@torch.no_grad()
def localize(
    registrar: PoseEstimator,
    images: Tensor | Sequence[Any],
    camera_matrices: Any | None = None,
    *,
    instances: int = 1,
    prior: PosePrior | Sequence[PosePrior | None] | None = None,
) -> list[list[_Result]]:
    """Find and register objects in whole photographs, the most certain first.

    The locator's best proposals are ranked as given boxes are, which yields the probability that each shows the object;
    the most certain are registered. The box around each pose is ranked too, and registered where it is more certain.

    Args:
        registrar: :class:`Registrar` of the meshes.
        images, camera_matrices, prior: see :class:`Registrar`.
        instances: largest number of objects in each photograph.

    Returns:
        For each photograph one to ``instances`` registrations with their ``localization``; or one that failed.

    Raises:
        InvalidInputError: not as many cameras or priors as images, a distance limited without cameras, or
            ``instances`` < 1.
    """
    if instances < 1:
        raise InvalidInputError(f"instances: expected >= 1, got {instances}")
    _ = registrar.locator  # create it once, before threads use it

    def localize_one(item: ImageItem | CurviregError, index: int) -> list[_Result]:
        if not isinstance(item, ImageItem):
            return [FailedRegistration(item)]
        registrar.report_progress("localization")
        try:
            check_crop(_extremes(item.image))
            cameras = None if item.camera_matrix is None else [item.camera_matrix]
            limits: dict[str, Any] = {}
            if item.prior is not None:
                limits = {"distance": item.prior.distance, "allowed": _allowed_views(registrar, item)}
            located = registrar.locator([item.image], camera_matrices=cameras, **limits)[0]
            if not len(located.boxes):
                raise InvalidInputError(
                    "nothing of such a size fits into the photograph; give other distances, or the box"
                )
            return [*_with_proposals(_register_candidates(registrar, item, located, instances), located)]
        except CurviregError as error:
            return [FailedRegistration(error.with_subject(f"image {index}"))]

    return registrar.map_items(
        image_items(images, None, camera_matrices, prior),
        lambda items, first: [localize_one(item, i) for i, item in enumerate(items, first)],
    )


def _allowed_views(estimator: PoseEstimator, item: ImageItem) -> Tensor:
    """(N,) bool: views of the bank that the prior does not exclude everywhere in the photograph, which is the box."""
    off_centre = 0.0
    if item.camera_matrix is not None:
        x0, y0, x1, y1 = item.box.double().tolist()
        points = torch.tensor([((x0 + x1) / 2, (y0 + y1) / 2, 1), (x0, y0, 1), (x1, y0, 1), (x0, y1, 1), (x1, y1, 1)])
        rays = F.normalize(torch.linalg.solve(item.camera_matrix.double(), points.double().T), dim=0)
        off_centre = float(torch.rad2deg(torch.acos((rays[:, :1] * rays[:, 1:]).sum(dim=0).clamp(-1, 1).min())))
    return BatchPriors([item], estimator.bank).log_prior(estimator.bank, off_centre=off_centre)[0].isfinite()


def _register_candidates(
    estimator: PoseEstimator, item: ImageItem, located: Located, instances: int
) -> list[Registration]:
    """The most certain objects, at most ``instances``, whose boxes do not overlap."""
    count = max(estimator.pipeline.locate.candidates, instances + 1)
    candidates = ScoredCandidates.score_boxes(estimator, item, located.boxes[:count], located.scores[:count])
    results: list[Registration] = []
    for k in non_maximum_suppression(candidates.boxes, candidates.presence, OVERLAP).tolist():
        if len(results) < instances:
            _add(results, _refined(estimator, item, candidates.register(estimator, item, k)))
    return sorted(results, key=_presence, reverse=True)


def _with_proposals(results: list[Registration], located: Located) -> list[Registration]:
    """Results with all proposals, their own boxes first, and with ``presence`` as a factor of their probabilities."""
    boxes = torch.cat([torch.stack([localization_of(r).box for r in results]), located.boxes.double()])
    scores = torch.cat([torch.tensor([localization_of(r).score for r in results]), located.scores])
    kept = non_maximum_suppression(boxes, -torch.arange(len(boxes)), OVERLAP)  # in their present order
    return [
        replace(
            result,
            localization=replace(localization_of(result), boxes=boxes[kept], scores=scores[kept]),
            answer_set=result.answer_set.scaled(_presence(result)),
        )
        for result in results
    ]


def _add(results: list[Registration], new: Registration) -> None:
    """Add a result. Of results whose boxes overlap the most certain is kept: proposals may lead to the same object."""
    boxes = torch.stack([localization_of(new).box, *(localization_of(result).box for result in results)])
    overlap = box_iou(boxes[:1], boxes[1:])[0].tolist()
    same = [result for result, iou in zip(results, overlap, strict=True) if iou > OVERLAP]
    if all(_presence(new) > _presence(result) for result in same):
        results[:] = [result for result in results if not any(result is other for other in same)]
        results.append(new)


@dataclass(frozen=True)
class ScoredCandidates:
    """P boxes of one photograph, described and ranked, with the probability that each shows the object."""

    boxes: Tensor
    scores: Tensor
    query: QueryFeatures
    ranking: Ranking
    evidence: list[list[float]]
    presence: Tensor

    @classmethod
    def score_boxes(
        cls, estimator: PoseEstimator, item: ImageItem, boxes: Tensor, scores: Tensor
    ) -> "ScoredCandidates":
        """Rank P boxes (P, 4) with the locator's ``scores`` (P,)."""
        query = estimator.matcher.query([item.image] * len(boxes), boxes)
        log_prior = None
        if item.prior is not None:
            each = [replace(item, box=box) for box in boxes.float()]
            log_prior = BatchPriors(each, estimator.bank).log_prior(estimator.bank)
        ranking = estimator.matcher.rank(query, log_prior)
        learned, numbers = estimator.locator.features.learned, scores.tolist()
        evidence = [presence_features(s, ranking[k : k + 1], learned=learned) for k, s in enumerate(numbers)]
        probability = torch.tensor([presence(features) for features in evidence], dtype=torch.float64)
        return cls(boxes, scores, query, ranking, evidence, probability)

    def register(self, estimator: PoseEstimator, item: ImageItem, k: int) -> Registration:
        """Register box ``k``; the result's box is the one around its pose."""
        one = slice(k, k + 1)
        result = estimator.register([replace(item, box=self.boxes[k])], self.query[one], self.ranking[one])[0]
        box, none = projected_box(estimator, result), (self.boxes[:0].double(), self.scores[:0])
        where = Localization(box, float(self.presence[k]), float(self.scores[k]), *none)
        return replace(result, localization=where)


def _refined(estimator: PoseEstimator, item: ImageItem, result: Registration) -> Registration:
    """The more certain one of a result and of the registration of the box around its pose."""
    where = localization_of(result)
    try:
        candidates = ScoredCandidates.score_boxes(estimator, item, where.box[None].float(), torch.tensor([where.score]))
    except InvalidInputError:  # the projected mesh lies outside the photograph: nothing there supports the pose
        return replace(result, localization=replace(where, presence=0.0))
    return result if float(candidates.presence[0]) <= where.presence else candidates.register(estimator, item, 0)


def _extremes(image: Tensor) -> Tensor:
    """(C, 2) smallest and largest value of each channel, NaN where one is missing; as :func:`check_crop` takes them."""
    pair = torch.stack([image.flatten(1).amin(dim=1), image.flatten(1).amax(dim=1)], dim=1)
    return pair.float() / 255.0 if image.dtype == torch.uint8 else pair


def localization_of(result: Registration) -> Localization:
    """``localization`` of a result that has one."""
    assert result.localization is not None
    return result.localization


def _presence(result: Registration) -> float:
    return localization_of(result).presence
