"""Poses without a box: places that the locator proposes are followed to poses, and what was found decides."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from kornia.geometry.bbox import nms
from torch import Tensor

from ...errors import CurviregError, InvalidInputError
from ...geometry.crops import box_iou
from ...matching import Ranking
from ...terms import QueryFeatures
from ..confidence import presence, presence_features
from ..correction import projected_box
from ..inputs import ImageItem, check_crop, image_items
from ..results import FailedRegistration, Localization, Registration
from . import Located
from .locator import OVERLAP, check_distance

if TYPE_CHECKING:
    from ..registrar import Registrar

__all__ = ["ScoredCandidates", "localize"]


@torch.no_grad()
def localize(
    registrar: "Registrar",
    images: Tensor | Sequence[Any],
    camera_matrices: Any | None = None,
    *,
    instances: int = 1,
    distance: tuple[float, float] | None = None,
) -> list[list[Registration | FailedRegistration]]:
    """The objects in whole photographs, the surest first.

    The locator's best places are ranked as given boxes are, which tells how surely each shows the object
    (:func:`curvireg_torch.registration.confidence.presence`); the surest are registered. The box around each pose is
    then ranked too, which makes good for the locator's steps, and registered once more where it is the surer one.

    Args:
        registrar: of the meshes.
        images, camera_matrices: see :class:`Registrar`.
        instances: at most so many objects of each photograph.
        distance: nearest and farthest that an object's centre may be, in the mesh's unit; needs cameras.

    Returns:
        For each photograph one to ``instances`` registrations, whose ``localization`` is set; or one failed.

    Raises:
        InvalidInputError: not as many cameras as images, ``instances`` < 1, or a bad ``distance``.
    """
    if instances < 1:
        raise InvalidInputError(f"instances: expected >= 1, got {instances}")
    check_distance(distance, with_cameras=camera_matrices is not None)
    _ = registrar.locator  # made once, before threads ask for it

    def looked_for(
        some: Sequence[ImageItem | CurviregError], first: int
    ) -> list[list[Registration | FailedRegistration]]:
        numbered = enumerate(some, start=first)
        return [_found_objects(registrar, item, f"image {i}", instances, distance) for i, item in numbered]

    return registrar.each(image_items(images, None, camera_matrices), looked_for)


def _found_objects(
    registrar: "Registrar",
    item: ImageItem | CurviregError,
    name: str,
    instances: int,
    distance: tuple[float, float] | None,
) -> list[Registration | FailedRegistration]:
    """:func:`localize` for one photograph."""
    if not isinstance(item, ImageItem):
        return [FailedRegistration(item)]
    registrar.report_progress("looking")
    try:
        check_crop(_extremes(item.image))
        cameras = None if item.camera_matrix is None else [item.camera_matrix]
        located = registrar.locator([item.image], camera_matrices=cameras, distance=distance)[0]
        return [*_followed(registrar, item, located, instances)]
    except CurviregError as error:
        return [FailedRegistration(error.with_subject(name))]


def _followed(registrar: "Registrar", item: ImageItem, located: Located, instances: int) -> list[Registration]:
    """The best ``instances`` objects among the places of one photograph."""
    if not len(located.boxes):
        raise InvalidInputError("nothing of such a size fits into the photograph; give other distances, or the box")
    count = max(registrar.pipeline.locate.candidates, instances + 1)
    places = ScoredCandidates.score_boxes(registrar, item, located.boxes[:count], located.scores[:count])
    answers: list[Registration] = []
    for k in nms(places.boxes, places.presence, OVERLAP).tolist():
        if len(answers) < instances:
            _add(answers, _corrected(registrar, item, places.registered(registrar, item, k)))
    answers.sort(key=_surely, reverse=True)
    boxes = torch.cat([torch.stack([found_in(a).box for a in answers]), located.boxes.double()])
    scores = torch.cat([torch.tensor([found_in(a).score for a in answers]), located.scores])
    own = nms(boxes, -torch.arange(len(boxes)), OVERLAP)  # in the order that they have
    answers = [replace(a, localization=replace(found_in(a), boxes=boxes[own], scores=scores[own])) for a in answers]
    return [replace(answer, confidence=answer.confidence * _surely(answer)) for answer in answers]


def _add(answers: list[Registration], new: Registration) -> None:
    """Add an answer. Of answers whose boxes overlap only the surest stays: two places may lead to one object."""
    boxes = torch.stack([found_in(new).box, *(found_in(answer).box for answer in answers)])
    overlap = box_iou(boxes[:1], boxes[1:])[0].tolist()
    same = [answer for answer, iou in zip(answers, overlap, strict=True) if iou > OVERLAP]
    if all(_surely(new) > _surely(answer) for answer in same):
        answers[:] = [answer for answer in answers if not any(answer is other for other in same)]
        answers.append(new)


@dataclass(frozen=True)
class ScoredCandidates:
    """P boxes of one photograph, described and ranked, and how surely each shows the object."""

    boxes: Tensor
    scores: Tensor
    query: QueryFeatures
    ranking: Ranking
    evidence: list[list[float]]
    presence: Tensor

    @classmethod
    def score_boxes(cls, registrar: "Registrar", item: ImageItem, boxes: Tensor, scores: Tensor) -> "ScoredCandidates":
        query = registrar.matcher.query([item.image] * len(boxes), boxes)
        ranking = registrar.matcher.rank(query)
        pictures = registrar.locator.cells.pictures
        ones = (ranking[k : k + 1] for k in range(len(boxes)))
        evidence = [presence_features(s, one, pictures=pictures) for s, one in zip(scores.tolist(), ones, strict=True)]
        sure = torch.tensor([presence(known) for known in evidence], dtype=torch.float64)
        return cls(boxes, scores, query, ranking, evidence, sure)

    def registered(self, registrar: "Registrar", item: ImageItem, k: int) -> Registration:
        """Box ``k`` as a registration, the box around its pose in the place of the one it began with."""
        one = slice(k, k + 1)
        result = registrar.register([replace(item, box=self.boxes[k])], self.query[one], self.ranking[one])[0]
        found = Localization(
            box=projected_box(registrar, result),
            presence=float(self.presence[k]),
            score=float(self.scores[k]),
            boxes=self.boxes[:0].double(),
            scores=self.scores[:0],
        )
        return replace(result, localization=found)


def _corrected(registrar: "Registrar", item: ImageItem, answer: Registration) -> Registration:
    """The better of an answer and of what the box around its pose leads to."""
    found = found_in(answer)
    try:
        places = ScoredCandidates.score_boxes(registrar, item, found.box[None].float(), torch.tensor([found.score]))
    except InvalidInputError:  # the pose has left the photograph: it is of nothing that is there
        return replace(answer, localization=replace(found, presence=0.0))
    if float(places.presence[0]) <= found.presence:
        return answer
    return places.registered(registrar, item, 0)


def _extremes(image: Tensor) -> Tensor:
    """(C, 2) smallest and largest value of each channel, NaN where there is one, of what is large as a whole."""
    pair = torch.stack([image.flatten(1).amin(dim=1), image.flatten(1).amax(dim=1)], dim=1)
    return pair.float() / 255.0 if image.dtype == torch.uint8 else pair


def found_in(result: Registration) -> Localization:
    """``localization`` of a result that has it."""
    assert result.localization is not None
    return result.localization


def _surely(result: Registration) -> float:
    return found_in(result).presence
