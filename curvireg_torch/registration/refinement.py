"""Refinement of known poses: contours are fitted around starts, without boxes; a registration
checks them."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..fitting.edges import EdgeCrops
from ..geometry.framing import boxes_at
from ..matching import Ranking
from ..utils.checks import as_numbers, check_pose, check_probability, check_tensor
from ..utils.likes import ArrayLike, CameraLike, ImagesLike
from ..utils.precision import exact_convolutions, full_precision
from .block import Described, evidence_of
from .camera import focal_covariance
from .confidence import are_near, is_calibrated, refinement_confidence
from .hypotheses import (
    Hypotheses,
    distinct_poses,
    fit_poses,
    fit_texture_of,
    hypothesis_of,
)
from .photograph import (
    MIN_BOX_SIDE,
    Photograph,
    as_photographs,
    check_cameras,
    check_crop,
    one_each,
)
from .result import FailedRegistration, Registration, Results
from .stages import Items, failure, register
from .target import Target, nearest_view

FACTORS = {
    1000.0: "too small, as metres beside a mesh in mm",
    0.001: "too large, as mm beside a mesh in metres",
}
"""Factors between translations and the mesh's unit, and what they mean."""

OUTSIDE = "at the start the mesh lies outside the photograph; check pose, unit and camera matrix"
"""Message of a LostObjectError."""

OPENGL = (
    "at the start the object lies behind the camera: a pose of OpenGL's camera? Then turn y and z "
    "around"
)

INVERSE = (
    "at the start the mesh lies outside the photograph: the pose of the camera in the object? Then "
    "give its inverse"
)


def why_outside(
    hull: Tensor, T: Tensor, K: Tensor, size: tuple[int, int]
) -> LostObjectError | None:
    """What is probably wrong with a pose (4, 4) at which a mesh is not seen; None if nobody knows.

    Args:
        hull: (V, 3) points of the mesh.
        T: (4, 4) model -> camera.
        K: (3, 3).
        size: (H, W) of the photograph.
    """
    for sign, factor in product((1.0, -1.0), (1.0, *FACTORS)):
        changed = T.clone()
        changed[1:3] *= sign
        changed[:3, 3] *= factor
        if (sign, factor) == (1.0, 1.0) or not _is_seen(hull, changed, K, size):
            continue
        unit = "" if factor == 1.0 else f"{FACTORS[factor]}; give translations in the mesh's unit"
        if sign == 1.0:
            return LostObjectError(f"at the start the translation is about 1000 times {unit}")
        also = f". Its translation is about 1000 times {unit}" if unit else ""
        return LostObjectError(f"{OPENGL}{also}", kind="opengl")
    inverse = torch.linalg.inv(T)
    if _is_seen(hull, inverse, K, size):
        return LostObjectError(INVERSE)
    inverse[1:3] *= -1.0
    if _is_seen(hull, inverse, K, size):
        return LostObjectError(f"{INVERSE} with y and z turned around, as of OpenGL's camera")
    return None


def _is_seen(hull: Tensor, T: Tensor, K: Tensor, size: tuple[int, int]) -> bool:
    """Whether a mesh fills a sensible part of the photograph: its centre is in it, it is neither
    tiny nor huge."""
    boxes, visible = boxes_at(hull, T[None], K[None], size)
    (x0, y0, x1, y1) = boxes[0].tolist()
    side = max(x1 - x0, y1 - y0)
    centre = torch.tensor([(x0 + x1) / 2, (y0 + y1) / 2])
    inside = bool((centre >= 0).all()) and bool((centre < torch.tensor([size[1], size[0]])).all())
    return bool(visible) and inside and MIN_BOX_SIDE <= side <= 2 * max(size)


# Hypotheses of the registration that checks a refined pose, even if fewer are reported
COMPARED = 5


@torch.no_grad()
def refine(
    target: Target,
    images: ImagesLike,
    camera_matrices: CameraLike | None,
    poses: ArrayLike,
    *,
    start_confidences: Sequence[float | None] | None = None,
) -> Results:
    """Refine poses of a mesh in photographs, without boxes.

    Contours are fitted around each start that shows the mesh in the photograph. A start should lie
    within about 15 degrees and 15 % of the distance of the truth. A fit from a wrong start may look
    as good as one from a good start, so the photograph is also registered in the box of the refined
    pose: the confidence is the smaller one of that of the fit and of the probability that the
    registration gives the pose, and never more than that of the start. What that registration warns
    of, such as another focal length than the camera's, holds for the refined pose too.

    Args:
        target: the object, a :class:`.Registrar`.
        images, camera_matrices: see :class:`Registrar`; the camera is needed, or EXIF data that
            have its focal length.
        poses: for each photograph a (4, 4) start ``T_cam_from_model``, or (S, 4, 4) of them.
        start_confidences: probabilities in [0, 1] of the starts of each photograph, if they are
            known, as those of earlier results are.

    Returns:
        For each photograph its refined poses, best first; where it hides the feature that tells
        turns of the mesh apart, the other turn is its rival. A :class:`FailedRegistration` with
        :class:`LostObjectError` where the object is not near any start.

    Raises:
        InvalidInputError: not as many cameras or starts as photographs, a start that is not rigid
            and finite, or a confidence that is no probability.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=45, elevations=[20])
        >>> bank = cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False)
        >>> start = scene.truth
        >>> (found,) = refine(cr.Registrar(bank), [scene.image], scene.camera_matrix, [start])
        >>> found.ok, len(found.hypotheses)
        (True, 1)
    """
    check_cameras(images, camera_matrices, "refine")
    items = as_photographs(images, None, camera_matrices)
    return refine_prepared(target, items, poses, start_confidences=start_confidences)


@torch.no_grad()
@full_precision()
def refine_prepared(
    target: Target,
    items: Items,
    poses: ArrayLike,
    *,
    start_confidences: Sequence[float | None] | None = None,
) -> Results:
    """:func:`refine` in photographs that :func:`.as_photographs` has prepared without boxes."""
    starts = []
    for one in one_each(poses, len(items), "poses"):
        T = as_numbers(one, "poses", dtype=torch.float64).cpu()
        T = T[None] if T.ndim == 2 else T
        check_tensor(T, "poses", (None, 4, 4))
        check_pose(T, "poses")
        if not len(T):
            raise InvalidInputError("poses: no start; give one, or leave the photograph out")
        starts.append(T)
    limits = [None] * len(items)
    if start_confidences is not None:
        limits = one_each(start_confidences, len(items), "start_confidences")
    limits = [None if c is None else check_probability(c, "start_confidences") for c in limits]
    results: Results = []
    with exact_convolutions():
        # items are read on demand, so that few are in memory
        for index, (item, start, limit) in enumerate(zip(items, starts, limits, strict=True)):
            if isinstance(item, CurviregError):
                results.append(FailedRegistration(item))
                continue
            try:
                results.append(refine_one(target, item, start, limit=limit))
            except CurviregError as error:
                results.append(failure(error, index))
    return results


def refine_one(
    target: Target, item: Photograph, T: Tensor, *, limit: float | None = None
) -> Registration:
    """Refine (S, 4, 4) starts in one photograph, see :func:`refine`; the confidence is at most
    ``limit``. Raises :class:`LostObjectError` where the object is not near any start."""
    settings = target.pipeline.fit
    T, boxes = _seen_starts(target, item, T)
    described, crops = _described(target, item, boxes)
    poses = _fitted(target, item, described, crops, T)
    evidence = evidence_of(target, described, poses)
    scores = evidence.scores(target.score_weights(exact=True))
    symmetries = target.symmetries_of(exact=True)
    distinct = distinct_poses(poses.rotation, scores, symmetries, angle=settings.same_pose_angle)
    order = scores.argsort(descending=True, stable=True)
    order = order[distinct[order]]
    best = order[:1]
    if item.focal_deviation:
        covariance, deviation = focal_covariance(target.describer, crops, poses[best], item)
        poses = replace(poses, covariance=poses.covariance.index_copy(0, best, covariance))
        item = item.by(item.K, focal_deviation=deviation)
    hypotheses = tuple(hypothesis_of(poses, h, evidence.named(h)) for h in order.tolist())
    features = {name: hypotheses[0].evidence[name] for name in ("similarity", "edge_support")}
    confidence = refinement_confidence(features)
    if confidence < settings.lost_confidence:
        raise LostObjectError(
            f"the object is not near the start (edge support {features['edge_support']:.2f}, "
            f"similarity {features['similarity']:.2f}); give another start, or register it again"
        )
    warnings = item.warnings + target.mesh_warnings
    probabilities: tuple[float, ...] = ()
    feature_is_hidden = False
    if is_calibrated(target.pipeline):
        registered = _registered(target, item, poses[best])
        near, siblings = _near(target, registered, poses.rotation[best[0]])
        probability = min(
            confidence,
            sum(registered.probabilities[k] for k in near),
            registered.confidence_bound,
            1.0 if limit is None else limit,
        )
        rivals = [registered.hypotheses[k] for k in siblings]
        of_rivals = [min(registered.probabilities[k], probability) for k in siblings]
        probabilities = (probability, *of_rivals, *[0.0] * (len(hypotheses) - 1))
        hypotheses = (hypotheses[0], *rivals, *hypotheses[1:])
        warnings = registered.warnings
        feature_is_hidden = registered.feature_is_hidden
    return Registration(
        hypotheses,
        probabilities,
        Ranking.none(),
        dict(features),
        warnings=warnings,
        notes=target.mesh_notes,
        camera=item.pinhole,
        feature_is_hidden=feature_is_hidden,
        reliable_from=settings.reliable,
    )


def _seen_starts(target: Target, item: Photograph, T: Tensor) -> tuple[Tensor, Tensor]:
    """The starts (N, 4, 4) that show the mesh in the photograph, and its boxes (N, 4) at them."""
    hull = target.describer.hull
    boxes, visible = boxes_at(hull, T, item.K, item.size)
    if not bool(visible.any()):
        raise why_outside(hull, T[0], item.K, item.size) or LostObjectError(OUTSIDE)
    T = T[visible]
    boxes = boxes[visible]
    if float((boxes[:, 2:] - boxes[:, :2]).amin(dim=1).max()) < MIN_BOX_SIDE:
        tiny = f"at the start the mesh is less than {MIN_BOX_SIDE} px wide; check unit and distance"
        raise why_outside(hull, T[0], item.K, item.size) or LostObjectError(tiny)
    return T, boxes


def _described(target: Target, item: Photograph, boxes: Tensor) -> tuple[Described, EdgeCrops]:
    """A photograph in each of some boxes (N, 4), as N photographs, and their crops."""
    count = len(boxes)
    images = [item.image] * count
    query = target.matcher.query(images, boxes.float())
    check_crop(query.crops[0])
    mask = target.object_mask(query, [item] * count)
    crops = EdgeCrops.cut(images, boxes.float(), target.describer.settings.margin, mask)
    described = Described(
        query=query,
        rankings=[Ranking.none()] * count,
        descriptor=target.describer.descriptor(query.field),
        crops=crops,
        keypoints=[None] * count,
        frames=[None] * count,
    )
    return described, crops


def _fitted(
    target: Target, item: Photograph, described: Described, crops: EdgeCrops, T: Tensor
) -> Hypotheses:
    """Contours fitted around starts (N, 4, 4), each in its own crop, and texture at the best."""
    describer = target.describer
    settings = target.pipeline.fit
    each = torch.arange(len(T))
    ranks = torch.zeros(len(T), dtype=torch.float64)
    poses = Hypotheses.at(T, item.K.expand(len(T), 3, 3), describer.centre, each, ranks)
    views = torch.tensor([nearest_view(target, R) for R in poses.rotation])
    poses = replace(poses, photograph=each, view=views)
    poses = fit_poses(describer, crops, poses, settings=settings, wide_angles=settings.wide_angles)
    weights = target.score_weights(exact=True)
    best = evidence_of(target, described, poses).scores(weights).argmax()[None]
    fitted = fit_texture_of(describer, crops, poses[best])
    return poses if fitted is None else poses.replaced(best, fitted)


def _registered(target: Target, item: Photograph, pose: Hypotheses) -> Registration:
    """A registration of the box that a pose projects to, which its rotation does not influence."""
    boxes, _ = boxes_at(target.describer.hull, pose.T, pose.cameras, item.size)
    query = target.matcher.query([item.image], boxes.float())
    item = replace(item, box=boxes[0].float())
    return register(target.with_hypotheses(COMPARED), [item], query)[0]


def _near(
    target: Target, registered: Registration, rotation: Tensor
) -> tuple[list[int], list[int]]:
    """Numbers of the hypotheses of a registration within 30 degrees of a ``rotation`` (3, 3), and
    of those that only a feature tells from them that the photograph hides."""
    is_hidden = registered.feature_is_hidden
    rotations = torch.stack([each.allocentric_rotation for each in registered.hypotheses])
    same = target.symmetries_of_answers(feature_is_hidden=is_hidden)
    near = are_near(rotations, rotation, same)
    alike = are_near(rotations, rotation, target.symmetries_of(exact=target.is_exact))
    siblings = alike & ~near if is_hidden else torch.zeros_like(near)
    return near.nonzero()[:, 0].tolist(), siblings.nonzero()[:, 0].tolist()
