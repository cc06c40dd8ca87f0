"""Refinement of known poses: contours are fitted around starts, without boxes; an independent ranking checks them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..geometry import rotation_error
from ..matching import Ranking
from ..utils.checks import as_numbers, check_pose
from .confidence import (
    MAX_MARGIN,
    RIVAL_ANGLE,
    is_calibrated,
    refinement_confidence,
    registration_confidence,
)
from .inputs import MIN_BOX_SIDE, ImageItem, check_crop, image_items
from .poses import (
    SCORE_WEIGHTS,
    Poses,
    distinct_poses,
    fit_poses,
    fit_texture_of,
    hypothesis_of,
    lifted,
    placed,
    similarities,
)
from .result import FailedRegistration, Registration
from .tracker import OUTSIDE, boxes_at

if TYPE_CHECKING:
    from .registrar import Registrar

__all__ = ["LOST_CONFIDENCE", "nearest_view", "refine"]

WIDE_ANGLES = (14.0, 22.0)
"""Degrees by which given starts are rotated away, to fit from there too: they may be worse than views of a bank."""

LOST_CONFIDENCE = 0.35
"""Confidence of the fit below which the object counts as lost, see docs/guides/known-pose.md."""


@torch.no_grad()
def refine(
    registrar: "Registrar",
    images: Tensor | Sequence[Any],
    camera_matrices: Any,
    poses: Any,
    *,
    start_confidences: Sequence[float | None] | None = None,
) -> list[Registration | FailedRegistration]:
    """Refine poses of a mesh in photographs, without boxes.

    Contours are fitted around each start that shows the mesh in the photograph. A start should lie within about 15
    degrees and 15 % of the distance of the truth. A fit from a wrong start may look as good as one from a good start,
    so the refined pose is compared with all views of the bank, which no start influences: the confidence is the smaller
    one of that of the fit and that of the ranking, and never more than that of the start.

    Args:
        registrar: :class:`Registrar` of the mesh.
        images, camera_matrices: see :class:`Registrar`; the camera is needed.
        poses: for each photograph a (4, 4) start ``T_cam_from_model``, or (S, 4, 4) of them.
        start_confidences: of the starts of each photograph, if they are known, as those of earlier results are.

    Returns:
        For each photograph its refined poses, best first. A :class:`FailedRegistration` with :class:`LostObjectError`
        where the object is not near any start.

    Raises:
        InvalidInputError: not as many cameras or starts as photographs, or a start that is not rigid and finite.
    """
    if camera_matrices is None:
        raise InvalidInputError("refine: needs the camera matrix of each photograph")
    items = image_items(images, None, camera_matrices)
    starts = [_starts(one) for one in poses]
    limits = [None] * len(items) if start_confidences is None else list(start_confidences)
    if len(starts) != len(items) or len(limits) != len(items):
        raise InvalidInputError(f"refine: expected starts of {len(items)} photographs, got {len(starts)}")

    def refine_some(some: Sequence[ImageItem | CurviregError], first: int) -> list[Registration | FailedRegistration]:
        return [_refine_one(registrar, item, starts[i], limits[i], i) for i, item in enumerate(some, first)]

    return registrar.map_items(items, refine_some)


def _starts(poses: Any) -> Tensor:
    T = as_numbers(poses, "poses", dtype=torch.float64).cpu()
    T = T[None] if T.ndim == 2 else T
    check_pose(T, "poses")
    return T


def _refine_one(
    registrar: "Registrar", item: ImageItem | CurviregError, T: Tensor, limit: float | None, index: int
) -> Registration | FailedRegistration:
    try:
        if not isinstance(item, ImageItem):
            raise item
        return refine_item(registrar, item, T, limit=limit)
    except CurviregError as error:
        subject = str(error.subject)
        return FailedRegistration(error if subject.startswith("image ") else error.with_subject(f"image {index}"))


def refine_item(
    registrar: "Registrar", item: ImageItem, T: Tensor, *, limit: float | None = None, check: bool = True
) -> Registration:
    """Refine (S, 4, 4) starts in one photograph, see :func:`refine`; without ``check``, only ``limit`` bounds the
    confidence.

    Raises:
        LostObjectError: the object is not near any start.
    """
    assert item.camera_matrix is not None
    describer, K = registrar.describer, item.camera_matrix.double()
    boxes, visible = boxes_at(describer.hull, T, K, item.size)
    if not bool(visible.any()):
        raise LostObjectError(OUTSIDE)
    T, boxes = T[visible], boxes[visible]
    if float((boxes[:, 2:] - boxes[:, :2]).amin(dim=1).max()) < MIN_BOX_SIDE:
        raise LostObjectError(f"at the start the mesh is less than {MIN_BOX_SIDE} px wide; check unit and distance")
    images, K = [item.image] * len(T), K.expand(len(T), 3, 3)
    query = registrar.matcher.query(images, boxes.float())
    check_crop(query.crops[0])
    descriptors = describer.descriptor(query.field)
    poses = _poses(registrar, T, K, boxes)
    mask = registrar.object_mask(query, [item] * len(T))
    poses = fit_poses(describer, images, poses, boxes, mask, wide_angles=WIDE_ANGLES)
    evidence = _evidence(registrar, descriptors, poses)
    best = _scores(evidence).argmax()
    if (fitted := fit_texture_of(describer, images, poses, boxes, int(best))) is not None:
        poses = poses.replaced(best[None], replace(fitted, image_index=best[None]))
        evidence = _evidence(registrar, descriptors, poses)
    scores, together = _scores(evidence), replace(poses, image_index=torch.zeros_like(poses.image_index))
    distinct = distinct_poses(together, scores, registrar.symmetries_of(exact=True))
    order = [h for h in scores.argsort(descending=True, stable=True).tolist() if distinct[h]]
    hypotheses = tuple(hypothesis_of(poses, h, evidence, with_camera=True) for h in order)
    features = {name: hypotheses[0].evidence[name] for name in ("similarity", "edge_support")}
    fit_confidence = refinement_confidence(features)
    if fit_confidence < LOST_CONFIDENCE:
        raise LostObjectError(
            f"the object is not near the start (edge support {hypotheses[0].edge_support:.2f}, similarity "
            f"{hypotheses[0].score:.2f}); give another start, or register it again"
        )
    confidence = fit_confidence if limit is None else min(fit_confidence, limit)
    if check:
        confidence = min(confidence, _ranked_confidence(registrar, item, poses[torch.tensor(order[:1])], features))
    probabilities = (confidence, *[0.0] * (len(hypotheses) - 1)) if is_calibrated(registrar.pipeline) else ()
    warnings = item.warnings + registrar.mesh_warnings
    return Registration(hypotheses, probabilities, Ranking.none(), dict(features), warnings=warnings)


def _poses(registrar: "Registrar", T: Tensor, K: Tensor, boxes: Tensor) -> Poses:
    """Poses ``T`` (S, 4, 4), each in a photograph of its own."""
    describer, every = registrar.describer, torch.arange(len(T))
    one = torch.ones(len(T), dtype=torch.float64)
    poses = lifted(describer, every, torch.zeros_like(every), 0.0 * one, T[:, :3, :3], one, boxes, K)
    poses = placed(poses, T, describer.centre)
    return replace(poses, view=torch.tensor([nearest_view(registrar, R) for R in poses.rotation]))


def _evidence(registrar: "Registrar", descriptors: Tensor, poses: Poses) -> Tensor:
    """(H, 4) :data:`POSE_FEATURES` of fitted poses, without ranking and appearance."""
    none = torch.zeros_like(poses.rank)
    return torch.stack([none, similarities(registrar.describer, descriptors, poses), poses.edge_support, none], dim=1)


def _scores(evidence: Tensor) -> Tensor:
    return evidence @ torch.tensor(SCORE_WEIGHTS, dtype=evidence.dtype)


def _ranked_confidence(registrar: "Registrar", item: ImageItem, pose: Poses, features: dict[str, float]) -> float:
    """Confidence in one pose if all views of the bank are ranked in the box that it projects to.

    The margin is that of the best view within 30 degrees of the pose over the best one beyond.
    """
    boxes, _ = boxes_at(registrar.describer.hull, pose.T, pose.cameras, item.size)
    query = registrar.matcher.query([item.image], boxes.float())
    scores = registrar.matcher.rank(query).scores[0].cpu().double()
    views = registrar.bank.rotations.cpu().double()
    symmetries = registrar.symmetries_of(exact=True)
    group = torch.eye(3)[None] if symmetries is None else symmetries[:, :3, :3]
    near = (rotation_error(views[:, None], pose.rotation @ group.double()) <= RIVAL_ANGLE).any(dim=1)
    if not bool(near.any()) or bool(near.all()):
        return registration_confidence({**features, "margin": None, "concentration": None}, exact=True)
    log = scores.clamp(min=1e-300).log()
    margin = float(log[near].max() - log[~near].max())
    weights = (scores / scores.max().clamp(min=1e-300)) ** 4
    share = float(weights[near].sum() / weights.sum())
    clamped = min(max(margin, -MAX_MARGIN), MAX_MARGIN)
    return registration_confidence({**features, "margin": clamped, "concentration": share}, exact=True)


def nearest_view(registrar: "Registrar", rotation: Tensor) -> int:
    """The view of the bank that is most similar to an allocentric rotation (3, 3)."""
    R = registrar.bank.rotations.cpu().double()
    return int((R.flatten(1) @ rotation.flatten()).argmax())
