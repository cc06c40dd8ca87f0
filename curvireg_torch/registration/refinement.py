"""Refinement of known poses: search and contour fit around starts, without ranking and without boxes."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..matching import Ranking
from ..utils.checks import as_numbers, check_pose
from .answer_set import AnswerSet
from .confidence import refinement_confidence
from .estimator import PoseEstimator
from .hypotheses import Hypotheses, distinct_mask
from .inputs import ImageItem, check_crop, image_items
from .poses import Poses, fit_poses, fit_texture_of, hypothesis_of, lift_to_poses, to_allocentric
from .rescoring import rescore, similarities
from .results import FailedRegistration, Registration
from .search import search
from .tracker import OUTSIDE, boxes_at

__all__ = ["LOST", "refine"]

LOST = 0.35
"""Confidence below which the object counts as lost, see docs/guides/known-pose.md."""


@torch.no_grad()
def refine(
    registrar: PoseEstimator, images: Tensor | Sequence[Any], camera_matrices: Any, poses: Any
) -> list[Registration | FailedRegistration]:
    """Refine poses of the first mesh of a bank in photographs, without ranking and without boxes.

    Around each start that shows the mesh in the photograph runs a short search; contours are fitted from its result and
    from the start itself, and the better pose wins. A start should lie within about 15 degrees and 15 % of the distance
    of the truth.

    Args:
        registrar: :class:`Registrar` of the mesh.
        images, camera_matrices: see :class:`Registrar`; the camera is needed.
        poses: for each photograph a (4, 4) start ``T_cam_from_model``, or (S, 4, 4) of them.

    Returns:
        For each photograph its refined poses, best first; their ``confidence`` is that of the best one to be within 10
        degrees and 10 % of the distance. A :class:`FailedRegistration` with :class:`LostObjectError` where the object
        is not near any start.

    Raises:
        InvalidInputError: not as many cameras or starts as photographs, or a start that is not rigid and finite.
    """
    if camera_matrices is None:
        raise InvalidInputError("refine: needs the camera matrix of each photograph")
    items = image_items(images, None, camera_matrices)
    starts = [_starts(one) for one in poses]
    if len(starts) != len(items):
        raise InvalidInputError(f"refine: expected starts of {len(items)} photographs, got {len(starts)}")

    def refine_some(some: Sequence[ImageItem | CurviregError], first: int) -> list[Registration | FailedRegistration]:
        return [_refine_one(registrar, item, starts[i], f"image {i}") for i, item in enumerate(some, first)]

    return list(registrar.map_items(items, refine_some))


def _starts(poses: Any) -> Tensor:
    T = as_numbers(poses, "poses", dtype=torch.float64).cpu()
    T = T[None] if T.ndim == 2 else T
    check_pose(T, "poses")
    return T


def _refine_one(
    estimator: PoseEstimator, item: ImageItem | CurviregError, T: Tensor, name: str
) -> Registration | FailedRegistration:
    if not isinstance(item, ImageItem):
        return FailedRegistration(item)
    try:
        result = _refined(estimator, item, T)
        if result.confidence < LOST:
            raise LostObjectError(
                f"the object is not near the start (edge support {result.edge_support:.2f}, similarity "
                f"{result.score:.2f}); give another start, or register it again"
            )
        return result
    except CurviregError as error:
        return FailedRegistration(error.with_subject(name))


def _refined(estimator: PoseEstimator, item: ImageItem, T: Tensor) -> Registration:
    assert item.camera_matrix is not None
    describers, K = estimator.describers, item.camera_matrix.double()
    boxes, visible = boxes_at(describers[0].hull, T, K, item.size)
    if not bool(visible.any()):
        raise LostObjectError(OUTSIDE)
    T, boxes = T[visible], boxes[visible]
    images, K = [item.image] * len(T), K.expand(len(T), 3, 3)
    query = estimator.matcher.query(images, boxes.float())
    check_crop(query.crops[0])
    descriptors = describers[0].descriptor(query.field)
    at_start = to_allocentric(describers, _hypotheses(len(T)), T)
    poses = Poses(at_start, T, K)
    if estimator.pipeline.search:
        found = search(describers, descriptors, at_start, boxes=boxes, camera_matrices=K, brief=True)
        poses = _side_by_side(poses, lift_to_poses(describers, found, boxes, K))
    poses = fit_poses(describers, images, poses, boxes, estimator.object_mask(query))
    evidence = _evidence(estimator, descriptors, poses)
    best = int(rescore(evidence, exact=True).argmax())
    if (fitted := fit_texture_of(describers, images, poses, boxes, best)) is not None:
        poses, evidence = fitted, _evidence(estimator, descriptors, fitted)
    scores = rescore(evidence, exact=True)
    together = replace(poses.hypotheses, image_index=torch.zeros_like(poses.hypotheses.image_index))
    distinct = distinct_mask(together, scores, symmetries=estimator.symmetries_of(exact=True))
    order = [h for h in scores.argsort(descending=True, stable=True).tolist() if distinct[h]]
    hypotheses = tuple(
        replace(
            hypothesis_of(h, poses, evidence, with_camera=True),
            view=nearest_view(estimator, poses.hypotheses.rotation[h]),
        )
        for h in order
    )
    features = {name: hypotheses[0].evidence[name] for name in ("similarity", "edge_support")}
    answers = AnswerSet((refinement_confidence(features), *[0.0] * (len(hypotheses) - 1)))
    return Registration(hypotheses, answers, Ranking.none(), features, warnings=item.warnings)


def _evidence(estimator: PoseEstimator, descriptors: Tensor, poses: Poses) -> Tensor:
    """(H, 4) :data:`POSE_FEATURES` of fitted poses, without ranking and appearance."""
    assert poses.fit is not None
    similarity, support = similarities(estimator.describers, descriptors, poses.hypotheses), poses.fit.edge_support
    return torch.stack([torch.zeros_like(support), similarity, support, torch.zeros_like(support)], dim=1)


def _hypotheses(count: int) -> Hypotheses:
    """Hypotheses of the bank's first model that come from no view."""
    none = torch.zeros(count, dtype=torch.long)
    ones = torch.ones(count, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    return Hypotheses(torch.arange(count), none, none, eye, ones, ones, ones * torch.nan)


def _side_by_side(a: Poses, b: Poses) -> Poses:
    """Both, in the order of their photographs."""
    order = torch.cat([a.hypotheses.image_index, b.hypotheses.image_index]).argsort(stable=True)
    joined = Hypotheses(
        *(torch.cat([getattr(a.hypotheses, f.name), getattr(b.hypotheses, f.name)]) for f in fields(Hypotheses))
    )
    return Poses(joined[order], torch.cat([a.T, b.T])[order], torch.cat([a.cameras, b.cameras])[order])


def nearest_view(estimator: PoseEstimator, rotation: Tensor) -> int:
    """The view of the bank's first model that is most similar to an allocentric rotation (3, 3)."""
    R = estimator.bank.rotations.cpu().double()
    traces = (R.flatten(1) @ rotation.flatten()).masked_fill(estimator.bank.model.cpu() != 0, -4.0)
    return int(traces.argmax())
