"""One pose from several photographs: each is registered alone, then candidates are compared in all
of them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..evidence import Evidence
from ..geometry.framing import border_sides, boxes_at, outside_fraction
from ..utils.likes import ArrayLike, BoxesLike, CameraLike, ImagesLike
from ..utils.precision import full_precision
from .confidence import (
    MAX_MARGIN,
    RIVAL_ANGLE,
    confidence_features,
    hypothesis_probabilities,
    is_calibrated,
    probability_of_any,
    undetermined_axes,
)
from .detection import detect_prepared
from .judging import best_of_meshes
from .photograph import Photograph, as_photographs, check_cameras, copies_of, rig_cameras
from .result import FailedRegistration, PhotographPose, Registration, Results, kinds_of
from .rig import ELSEWHERE, JointPoses, Rig, RigPhotograph, RigPhotographs
from .stages import register_photographs
from .target import Target

# Distance of two places, as a fraction of that of the camera, from which they are different ones
OTHER_PLACE = 0.15
# Confidence of a photograph alone from which another pose in it contradicts that of the others
CONVINCED = 0.5
# Factor by which the distances of an object by its size and by the places of the cameras may
# differ: if they do so more in all photographs, something is wrong. In right generated rigs it is
# 0.99 to 1.00, with translations of 0.9 times their length 1.08 to 1.10
OTHER_SCALE = 1.07
# Hypotheses of each photograph that are compared in all, even if fewer are reported
JOINT_HYPOTHESES = 5


@torch.no_grad()
def register_views(
    target: Target,
    images: ImagesLike,
    boxes: BoxesLike | None,
    camera_matrices: CameraLike | None,
    T_cam_from_world: ArrayLike,
) -> Registration:
    """Register several photographs of one object together: one pose in the world.

    Each photograph is registered alone. The hypotheses of all become poses in the world, which are
    moved to where the photographs agree that the object is, fitted to the contours in all
    photographs at once, and ordered by the sum of their scores. One photograph lowers a pose by at
    most five points, and those from nearly the same side share one vote; a copy, from the same
    place, counts for nothing. A photograph that does not show the best pose is left out, and the
    others decide again. If it is sure of another rotation, that lowers the confidence; so does
    another place, unless most photographs show the pose. What more than half of the photographs
    warn of holds for the joint pose, and it has a warning where as many are convinced of another
    pose as show it, or where their distances from the object's size contradict the cameras' places.

    Args:
        target: the object, a :class:`.Registrar`.
        images: V photographs, see :class:`Registrar`.
        boxes: (V, 4), or a list with None where the poses of the others say where the object is.
            None: the object is searched for in each photograph.
        camera_matrices: see :class:`Registrar`; needed, or EXIF data that have the focal length.
        T_cam_from_world: (V, 4, 4) rigid poses of the cameras, with lengths in the mesh's unit.

    Returns:
        A registration whose poses are ``T_world_from_model``, whose covariance is along the world's
        axes, and whose ``views`` have the pose in each photograph. ``projection`` and ``ranking``
        are those of the first photograph that counts. The covariance does not know the errors of
        the cameras; it grows where photographs contradict each other.

    Raises:
        InvalidInputError: no photograph can be registered; a camera's pose is not rigid; two
            photographs that differ come from the same place; or lengths of the cameras and of the
            mesh differ by a factor of 30 and more, as mm and m do.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=20, elevations=[10, 30])
        >>> registrar = cr.Registrar(cr.ViewBank.build(scene.mesh, views, image_size=64,
        ...     progress=False))
        >>> rig = torch.eye(4).double()[None]
        >>> result = registrar.register_views([scene.image], [scene.box], scene.camera_matrix, rig)
        >>> result.transform.shape, len(result.views)
        (torch.Size([4, 4]), 1)
    """
    check_cameras(images, camera_matrices, "register_views")
    items = list(as_photographs(images, boxes, camera_matrices))
    return register_prepared_views(target, items, T_cam_from_world)


@torch.no_grad()
@full_precision()
def register_prepared_views(
    target: Target, items: Sequence[Photograph | CurviregError], T_cam_from_world: ArrayLike
) -> Registration:
    """:func:`register_views` with photographs that :func:`.as_photographs` has prepared, or why one
    cannot be used."""
    cameras = rig_cameras(T_cam_from_world, len(items))
    copies = copies_of(cameras, items)
    meshes = (target, *target.others)
    found: Results = []
    for mesh in meshes:
        try:
            found.append(_registered_to(mesh, items, cameras, copies))
        except CurviregError as error:
            found.append(FailedRegistration(error))
    result = best_of_meshes(found, meshes)
    if isinstance(result, FailedRegistration):
        raise result.error
    return result


def _registered_to(
    target: Target,
    items: Sequence[Photograph | CurviregError],
    cameras: Tensor,
    copies: Mapping[int, int],
) -> Registration:
    """The joint registration to one mesh, of ``cameras`` with these poses (V, 4, 4)."""
    count = target.pipeline.hypotheses
    target = target.with_hypotheses(JOINT_HYPOTHESES)
    found: RigPhotographs = {}
    photographs: dict[int, Photograph] = {}
    for i, item in enumerate(items):
        if isinstance(item, CurviregError):
            found[i] = item
        elif i in copies:
            found[i] = InvalidInputError("a copy of an earlier photograph, which counts once")
        else:
            photographs[i] = item
    if given := {i: item for i, item in photographs.items() if item.has_box}:
        found |= _registered(target, given, cameras)
    else:
        detected = _detected(target, photographs, cameras)
        # they tell where it is in the others
        is_found = any(isinstance(one, RigPhotograph) for one in detected.values())
        for i, one in detected.items():
            if not (is_found and isinstance(one, LostObjectError)):
                found[i] = one
    if missing := photographs.keys() - found.keys():
        where = Rig.of(target, found).answer().T[:1]
        placed = {i: _placed(target, photographs[i], cameras[i], where) for i in sorted(missing)}
        found |= _registered(target, placed, cameras)
    return _registration(target, found, cameras, count)


def _detected(target: Target, items: Mapping[int, Photograph], cameras: Tensor) -> RigPhotographs:
    """Photographs, by their index, in which the object was searched for, or why it was not
    found."""
    found: RigPhotographs = {}
    results = detect_prepared(target, list(items.values()))
    for (i, item), (result,) in zip(items.items(), results, strict=True):
        if isinstance(result, FailedRegistration):
            found[i] = result.error.with_subject("").of_image(i)
            continue
        assert result.detection is not None
        item = replace(item, box=result.detection.box.float())
        found[i] = RigPhotograph.of(target, item, result, i, cameras[i])
    return found


def _registered(
    target: Target, items: Mapping[int, Photograph | CurviregError], cameras: Tensor
) -> RigPhotographs:
    """Photographs, by their index, registered alone in their boxes."""
    found: RigPhotographs = {}
    results = register_photographs(target, list(items.values()))
    for (i, item), result in zip(items.items(), results, strict=True):
        if isinstance(result, FailedRegistration):
            found[i] = result.error.with_subject("").of_image(i)
        elif isinstance(item, Photograph):
            found[i] = RigPhotograph.of(target, item, result, i, cameras[i])
    return found


def _placed(
    target: Target, item: Photograph, camera: Tensor, T: Tensor
) -> Photograph | CurviregError:
    """A photograph with the box around a world pose ``T`` (1, 4, 4)."""
    try:
        box, visible = boxes_at(target.describer.hull, camera @ T, item.K, item.size)
    except CurviregError as error:
        return error
    return replace(item, box=box[0].float()) if bool(visible) else LostObjectError(ELSEWHERE)


def _registration(
    target: Target, found: RigPhotographs, cameras: Tensor, count: int
) -> Registration:
    """The joint result of photographs, without those that failed or do not show the best pose;
    ``count`` hypotheses."""
    reasons = {i: one.message for i, one in found.items() if isinstance(one, CurviregError)}
    rig = every = Rig.of(target, found)
    answer = rig.answer()
    compared = _evidence_of_best(rig, answer)
    if lost := rig.lost(answer):
        reasons |= lost
        rig = Rig(target, [p for p in rig.photographs if p.index not in lost])
        answer = rig.answer()
        compared |= _evidence_of_best(rig, answer)
    first = rig.photographs[0]
    weights = rig.weights(answer.T[0])
    total = weights @ answer.scores
    mean = answer.evidence.mean(weights)
    features = _joint_features(rig, mean, total, weights, answer)
    # the hypotheses of all photographs led to the same pose
    if len(total) == 1 and len(rig.photographs) > 1:
        features["margin"] = MAX_MARGIN
    probabilities = first.result.probabilities
    if is_calibrated(target.pipeline) and len(every.photographs) > 1:
        probabilities = _joint_probabilities(rig, every, answer, total, features)
    margins = weights * (
        answer.scores[:, 0] - answer.scores[:, 1] if len(total) > 1 else MAX_MARGIN
    )
    contributions = dict(zip([p.index for p in rig.photographs], margins.tolist(), strict=True))
    views = []
    for i, camera in enumerate(cameras):
        one = found[i]
        measured = compared.get(i, {})
        view = PhotographPose(
            camera @ answer.T[0],
            box=one.photograph.box if isinstance(one, RigPhotograph) else None,
            edge_support=measured.get("edge_support"),
            similarity=measured.get("similarity"),
            contribution=contributions.get(i, 0.0),
            failure=reasons.get(i),
        )
        views.append(view)
    return Registration(
        hypotheses=tuple(rig.hypothesis(answer, m, mean) for m in range(min(count, len(total)))),
        probabilities=probabilities[:count],
        ranking=first.result.ranking,
        confidence_features=features,
        warnings=_warnings(rig, every, answer.T[:1]),
        notes=first.result.notes,
        feature_is_hidden=rig.feature_is_hidden,
        views=tuple(views),
        reliable_from=target.pipeline.fit.reliable,
    )


def _warnings(rig: Rig, every: Rig, T: Tensor) -> tuple[str, ...]:
    """What is questionable about a ``rig`` whose best pose is ``T`` (1, 4, 4): what most of its
    photographs warn of; that as many others, in the rig of ``every`` photograph, are convinced of
    another pose; and that the object's size and the cameras' places tell other distances."""
    found = list(_warnings_of_most([p.result for p in rig.photographs]))
    counted = {p.index for p in rig.photographs}
    others = [p.result for p in every.photographs if p.index not in counted]
    against = sum((other.confidence or 0.0) >= CONVINCED for other in others)
    if against >= len(counted):
        found.append(
            f"photographs contradict the pose ({against} of {len(every.photographs)}): check that "
            "T_cam_from_world belongs to them, in their order, and is not its inverse"
        )
    alone = torch.tensor([p.result.distance for p in rig.photographs], dtype=torch.float64)
    ratios = alone / torch.linalg.vector_norm(rig.centres(T) - rig.eyes, dim=-1)
    is_other = ratios.min() > OTHER_SCALE or ratios.max() < 1.0 / OTHER_SCALE
    if rig.exact and len(ratios) > 1 and is_other:
        found.append(
            f"by its size the object is {float(ratios.mean()):.2f} times as far away as by the "
            "places of the cameras: check the translations of T_cam_from_world, the focal length "
            "and the mesh's size"
        )
    return tuple(found)


def _warnings_of_most(results: Sequence[Registration]) -> tuple[str, ...]:
    """What more than half of the results warn of, as the first of them says it."""
    kinds = kinds_of(text for result in results for text in result.warnings)
    return tuple(sorted(texts[0] for texts in kinds.values() if 2 * len(texts) > len(results)))


def _joint_probabilities(
    rig: Rig, every: Rig, answer: JointPoses, total: Tensor, features: Mapping[str, float | None]
) -> tuple[float, ...]:
    """Probabilities of the poses with the sums ``total`` (M,) of scores in a ``rig``, which has
    ``every`` photograph but those that do not show the best pose: where these are confident of
    another rotation, that speaks against it; so does another place, unless most photographs show
    the pose: a wrong camera is out-voted."""
    probabilities = rig.photographs[0].result.probabilities
    if len(rig.photographs) > 1:
        found_in = [p.result.detection for p in every.photographs]
        scores = [detection.score for detection in found_in if detection is not None] or [1.0]
        any_right = max(scores) * probability_of_any(features, exact=rig.exact)
        probabilities = hypothesis_probabilities(any_right, total, exact=rig.exact)
    odds = probabilities[0] / max(1.0 - probabilities[0], 1e-9)
    counted = {p.index for p in rig.photographs}
    is_majority = 2 * len(counted) > len(every.photographs)
    place = rig.centres(answer.T[:1])
    for p in every.photographs:
        if p.index in counted:
            continue
        away = torch.linalg.vector_norm(rig.centres(p.poses[:1]) - place)
        is_elsewhere = not is_majority and bool(away > OTHER_PLACE * p.result.distance)
        # one that hides the feature does not contradict the turn that it tells
        shape_alone = p.result.feature_is_hidden
        angle = rig.angles(p.poses[:1], answer.T[:1], shape_alone=shape_alone)
        if is_elsewhere or angle > RIVAL_ANGLE:
            other = p.result.confidence or 0.0
            odds *= min(1.0, (1.0 - other) / max(other, 1e-9))
    factor = odds / (1.0 + odds) / max(probabilities[0], 1e-9)
    return tuple(factor * probability for probability in probabilities)


def _evidence_of_best(rig: Rig, answer: JointPoses) -> dict[int, dict[str, float]]:
    """What speaks for the best pose in each photograph, by the photograph's index."""
    best = answer.evidence[:, 0]
    return {photograph.index: best.named(v) for v, photograph in enumerate(rig.photographs)}


def _joint_features(
    rig: Rig, mean: Evidence, total: Tensor, weights: Tensor, answer: JointPoses
) -> dict[str, float | None]:
    """:func:`.confidence_features` of the joint pose: ``mean`` evidence of M poses, ``total`` (M,)
    scores."""
    measured = [p.result.confidence_features for p in rig.photographs]
    known = [
        features["ranking_share"] for features in measured if features["ranking_share"] is not None
    ]
    outside = [
        outside_fraction(
            rig.describer.hull, p.camera @ answer.T[0], p.photograph.K, p.photograph.size
        )
        for p in rig.photographs
    ]
    border = [float(border_sides(p.photograph.box, p.photograph.size)) for p in rig.photographs]
    weights = weights / weights.sum()
    return confidence_features(
        mean,
        total,
        sum(known) / len(known) if known else None,
        printed=max(p.printed(0) for p in rig.photographs),
        undetermined=undetermined_axes(answer.covariance[0], rig.symmetries),
        outside=float(weights @ torch.tensor(outside).to(weights)),
        border=float(weights @ torch.tensor(border).to(weights)),
    )
