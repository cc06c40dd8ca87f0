"""Judgement of fitted poses: their order, their probabilities, what of them is determined, and the
best of several meshes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from ..errors import CurviregError
from ..evidence import Evidence, EvidenceWeights
from ..fitting.details import ContourDetails, compared, contour_details
from ..fitting.edges import EdgeCrops
from ..fitting.least_squares import apply_twist
from ..fitting.measured_fit import ideal_covariance
from ..geometry.framing import border_sides, outside_fraction
from ..mesh.round_axis import RoundAxis
from .block import Block, with_evidence
from .confidence import (
    MAX_MARGIN,
    RIVAL_ANGLE,
    ROUNDING,
    are_near,
    confidence_features,
    hypothesis_probabilities,
    is_calibrated,
    is_round,
    probability_of_any,
    ranking_share,
    shares,
    undetermined_axes,
)
from .hypotheses import Hypotheses, by_contours, hypothesis_of, placed
from .photograph import Photograph
from .result import (
    AXIS_TOLERANCE,
    UNKNOWN_ROTATION,
    Axis,
    FailedRegistration,
    Registration,
    ambiguity,
)
from .target import Target


@dataclass(frozen=True)
class Rivals:
    """R distinct poses that compete for a photograph, the best first, and the views of the bank.

    Attributes:
        rotations: (R, 3, 3) allocentric.
        scores: (R,) by which they are ordered.
        margins: (R,) scores without keypoints.
        features: :func:`.confidence_features` of the best one.
        view_rotations: (N, 3, 3) of the bank.
        view_scores: (N,) of the ranking.
    """

    rotations: Tensor
    scores: Tensor
    margins: Tensor
    features: Mapping[str, float | None]
    view_rotations: Tensor
    view_scores: Tensor

    def probability(self, members: Tensor, views: Tensor, *, turns: bool = False) -> float:
        """Probability that one of the ``members`` (R,) bool, of which the best pose is one, is
        right; ``views`` (N,) bool are those near them. ``turns``: the rotation about one axis need
        not be determined. Poses that all agree have the largest margin."""
        others = self.margins[~members]
        margin = MAX_MARGIN
        if len(others):
            margin = float((self.margins[0] - others.max()).clamp(-MAX_MARGIN, MAX_MARGIN))
        share = ranking_share(self.view_scores, views.to(self.view_scores.device))
        features = {**self.features, "margin": margin, "ranking_share": share}
        if turns:
            undetermined = self.features["undetermined"] or 0.0
            features["undetermined"] = max(undetermined - 1.0, 0.0)
        any_right = probability_of_any(features, exact=True)
        return any_right * float(shares(self.scores, exact=True)[members].sum())


def axis_of(rivals: Rivals, axis: RoundAxis, rotation: Tensor) -> Axis:
    """Where the ``axis`` of a mesh points at a pose's ``rotation`` (3, 3), and how probable that
    is."""
    same = directions_agree(rivals.rotations, axis, AXIS_TOLERANCE)
    near = directions_agree(rivals.view_rotations, axis, RIVAL_ANGLE, reference=rivals.rotations[0])
    direction = rotation.double() @ axis.direction
    return Axis(direction, rivals.probability(same, near, turns=True))


def directions_agree(
    rotations: Tensor, axis: RoundAxis, degrees: float, *, reference: Tensor | None = None
) -> Tensor:
    """(N,) bool: whether the axis of a mesh at rotations (N, 3, 3) points within ``degrees`` of
    where it does at the ``reference`` (3, 3), by default the first of them."""
    reference = rotations[0] if reference is None else reference
    directions = rotations.double() @ axis.direction.to(rotations.device)
    cosine = directions @ (reference.double() @ axis.direction).to(directions)
    if axis.ends_are_alike:
        cosine = cosine.abs()
    return torch.rad2deg(cosine.clamp(-1.0, 1.0).acos()) <= degrees + ROUNDING


def pair_probability(rivals: Rivals, symmetries: Tensor | None) -> float:
    """Probability that the best pose or its first rival is right."""
    members = torch.zeros(len(rivals.scores), dtype=torch.bool)
    members[:2] = True
    near = [are_near(rivals.view_rotations, R, symmetries) for R in rivals.rotations[:2]]
    return rivals.probability(members, near[0] | near[1])


# Score that a pose must lose where it is turned by RIVAL_ANGLE to either side, for its turn to be
# determined: with scores as log probabilities that fall with the square of the angle, nine in ten
# turns then lie within
LEAST_LOSS = 1.353


def with_determined_turns(
    target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses
) -> Hypotheses:
    """Poses, where the covariance of each photograph's best one contains what finite turns
    determine.

    The contours of a flat bottle that is seen from its broad side hardly move where it turns a
    little about its axis: to first order nothing determines that turn. By 30 degrees they change
    plainly, and what the score loses there gives the deviation of the turn. It counts only where
    the contours of the mesh leave the same turn open even if the photograph shows all of them. If
    not, the photograph lacks edges that the mesh predicts: perhaps it shows another object. The
    turn of a body of revolution about its axis need not be determined.
    """
    if is_round(block.symmetries):
        return poses
    for row in poses.best(target.score_weights(exact=True)).split(1):
        covariance = _with_finite_turn(target, block, crops, poses[row])
        if covariance is not None:
            covariances = poses.covariance.index_copy(0, row, covariance[None])
            poses = replace(poses, covariance=covariances)
    return poses


def _with_finite_turn(
    target: Target, block: Block, crops: EdgeCrops, best: Hypotheses
) -> Tensor | None:
    """Covariance (6, 6) of a pose of which one turn is open to first order and a finite one is not;
    None for others."""
    covariance = best.covariance[0]
    if not bool(covariance.isfinite().all()):
        return None
    variances, axes = torch.linalg.eigh(covariance[:3, :3])
    is_open = variances >= UNKNOWN_ROTATION**2
    axis = axes[:, 2]
    if is_open.tolist() != [False, False, True]:
        return None
    ideal = by_contours(ideal_covariance, target.describer, crops, best)[0, :3, :3]
    if not float(axis @ ideal @ axis) >= UNKNOWN_ROTATION**2:
        return None
    along = covariance[:, :3] @ axis
    centre = target.describer.centre
    # the motion of the centre that belongs to the turn, which need not be about the centre
    lever = best.T[0, :3, :3] @ centre
    motion = torch.cat([axis, along[3:] / variances[2] + torch.linalg.cross(axis, lever)])
    twist = math.radians(RIVAL_ANGLE) * torch.stack([0.0 * motion, motion, -motion])
    copies = best[torch.zeros(3, dtype=torch.long)]
    turned = with_evidence(
        target, block, placed(copies, apply_twist(copies.T, twist, centre), centre)
    )
    scores = turned.evidence.scores(target.score_weights(exact=True))
    loss = float(scores[0] - scores[1:].max())
    if loss < LEAST_LOSS:
        return None
    # as if the turn had been measured, so that the covariance with other motions stays consistent
    variance = math.radians(RIVAL_ANGLE) ** 2 / (2.0 * loss)
    removed: Tensor = (1.0 - variance / variances[2]) / variances[2] * torch.outer(along, along)
    return covariance - removed


# Fraction of the object outside the photograph from which a result carries a warning
MUCH_OUTSIDE = 0.1
OUTSIDE_MARGIN = 1.0
"""Score by which a pose outside the limits must be better to contradict them: 0.1 of similarity, or
of the evidence of contours."""


def judged(
    target: Target,
    block: Block,
    photograph: int,
    poses: Hypotheses,
) -> Registration:
    """Hypotheses, best first, then its rivals, then those that are near the best or merged with
    another, and their probabilities.

    Args:
        target: the object.
        block: the photograph, among others.
        photograph: its number in the block.
        poses: those in it, of which some that merged with the only other one have returned to
            their views.
    """
    weights = target.score_weights(exact=block.exact)
    item = block.photographs[photograph]
    ranking = block.rankings[photograph]
    evidence = poses.evidence
    outside = poses.is_outside
    distinct = poses.is_distinct
    scores = evidence.scores(weights)
    order = (scores + torch.where(distinct, 0.0, -1e6)).argsort(descending=True, stable=True)
    own = order[~outside[order]]
    best = own[:1]
    # Poses that merged, and those near the best, which are right if it is, have no probability of
    # their own.
    is_rival = distinct[own] & ~_near_best(block, poses[own])
    is_rival[0] = True
    rivals = own[is_rival]
    own = torch.cat([rivals, own[~is_rival]])
    # where there is no rival, those near the best or merged with it tell how clear it is
    groups = (rivals, own[distinct[own]], own)
    compared = next((group for group in groups if len(group) > 1), own)
    reported = own[: target.pipeline.hypotheses].tolist()
    fraction = _outside_fraction(target, item, poses[best])
    near = are_near(target.bank.views.rotations, poses.rotation[best[0]], block.symmetries)
    measured = confidence_features(
        evidence[compared],
        evidence[compared].scores(replace(weights, keypoints=0.0)),
        ranking_share(ranking.scores[0], near),
        printed=block.printed(photograph),
        undetermined=undetermined_axes(poses.covariance[best[0]], block.symmetries),
        outside=fraction,
        border=border_sides(item.box, item.size),
        focal=item.focal_deviation,
    )
    gain = _gain_outside(target, evidence, best, order[outside[order]])
    # limits that leave no rival do not make a pose uncertain
    if gain is not None and len(compared) == 1:
        share = measured["ranking_share"] or 1.0
        measured = {**measured, "margin": max(-gain, 0.0), "ranking_share": share}
    probabilities: tuple[float, ...] = ()
    axis = None
    of_pair = None
    if is_calibrated(target.pipeline):
        any_right = probability_of_any(measured, exact=block.exact)
        every = hypothesis_probabilities(any_right, scores[rivals], exact=block.exact)
        probabilities = (*every, *[0.0] * (len(own) - len(rivals)))[: len(reported)]
        if block.exact:
            axis, of_pair = _of_groups(target, block, photograph, poses[rivals], measured)
    with_camera = item.camera is not None
    hypotheses = [
        hypothesis_of(poses, h, evidence.named(h), with_camera=with_camera) for h in reported
    ]
    return Registration(
        tuple(hypotheses),
        probabilities,
        ranking,
        measured,
        prior=item.prior,
        prior_contradiction=_contradiction(target, block, photograph, poses[best], gain),
        warnings=item.warnings + target.mesh_warnings + outside_warnings(fraction),
        notes=target.mesh_notes,
        camera=item.pinhole,
        axis=axis,
        pair_probability=of_pair,
        reliable_from=target.pipeline.fit.reliable,
    )


def _of_groups(
    target: Target,
    block: Block,
    photograph: int,
    rivals: Hypotheses,
    measured: Mapping[str, float | None],
) -> tuple[Axis | None, float | None]:
    """Where the axis of a nearly round object points, and the probability that one of two poses is
    right that are each other's half turn or mirror image; each None where there is none."""
    weights = target.score_weights(exact=True)
    compared = Rivals(
        rivals.rotation,
        rivals.evidence.scores(weights),
        rivals.evidence.scores(replace(weights, keypoints=0.0)),
        measured,
        target.bank.views.rotations,
        block.rankings[photograph].scores[0],
    )
    round_axis = target.round_axis
    axis = None
    if round_axis is not None:
        has_camera = block.photographs[photograph].camera is not None
        rotation = rivals.T[0, :3, :3] if has_camera else rivals.rotation[0]
        axis = axis_of(compared, round_axis, rotation)
    if ambiguity(rivals.rotation[:2]) not in ("half turn", "mirror"):
        return axis, None
    return axis, pair_probability(compared, block.symmetries)


def _near_best(block: Block, poses: Hypotheses) -> Tensor:
    """(H,) bool: poses near the first one, up to symmetries of the object, which siblings are not:
    a feature of the mesh tells them apart."""
    R = poses.rotation
    near = are_near(R, R[0], block.symmetries)
    is_sibling = poses.is_sibling
    return torch.where(is_sibling | is_sibling[0], are_near(R, R[0]), near)


def _outside_fraction(target: Target, item: Photograph, best: Hypotheses) -> float:
    """Fraction of the object that lies outside the photograph at the ``best`` pose."""
    return outside_fraction(target.describer.hull, best.T[0], best.cameras[0], item.size)


def _gain_outside(
    target: Target, evidence: Evidence, best: Tensor, outside: Tensor
) -> float | None:
    """Score of the pose outside the limits, minus that of the best one; without the rank, which it
    does not have."""
    if not len(outside):
        return None
    weights = replace(target.score_weights(exact=True), rank=0.0)
    gained = evidence[outside].table - evidence[best].table
    return float(Evidence.from_table(gained).scores(weights))


def _contradiction(
    target: Target, block: Block, photograph: int, best: Hypotheses, gain: float | None
) -> str | None:
    """See :attr:`.Registration.prior_contradiction`."""
    limits = block.limits[photograph]
    if limits is None:
        return None
    placement = best.rotation, best.distance, best.view, best.rank
    boxes = block.boxes[photograph, None]
    cameras = block.cameras[photograph, None]
    filling = Hypotheses.in_boxes(target.describer, boxes, cameras, *placement)
    better = gain is not None and gain > OUTSIDE_MARGIN
    return limits.contradiction(best, filling, better_outside=better)


def outside_warnings(fraction: float) -> tuple[str, ...]:
    """What is questionable about a photograph that does not show a ``fraction`` of the object."""
    if fraction < MUCH_OUTSIDE:
        return ()
    return (
        f"{100 * fraction:.0f} % of the object lies outside the photograph; take one that shows "
        f"all of it",
    )


DETAILED = 5.0
"""Score by which a mesh may be behind the best one to be compared with it in detail."""


def best_of_meshes(
    results: Sequence[Registration | FailedRegistration],
    targets: Sequence[Target],
    item: Photograph | None = None,
) -> Registration | FailedRegistration:
    """The best of the results of several meshes for one photograph, the ``item``; None for several
    photographs together, which are not compared in detail.

    The probabilities of the best one are those among the poses of all meshes;
    ``mesh_probabilities`` has that of each mesh. Similar meshes have no scores in common: the more
    confident one is the best, and so it is without probabilities, by the score.
    """
    posed = [k for k, result in enumerate(results) if isinstance(result, Registration)]
    if not posed:
        return results[0]
    found = [result for result in results if isinstance(result, Registration)]
    if len(found) == 1:
        return replace(found[0], mesh_index=posed[0])
    if not all(one.probabilities for one in found) or not all(t.is_exact for t in targets):
        order = [(one.confidence or 0.0, one.score) for one in found]
        best = order.index(max(order))
        return replace(found[best], mesh_index=posed[best])
    weights = targets[0].score_weights(exact=True)
    scores = [_rival_scores(one, weights) for one in found]
    if item is not None:
        scores = _compared_in_detail(scores, found, [targets[k] for k in posed], item)
    tops = torch.stack([one.max() for one in scores])
    best = int(tops.argmax())
    share = shares(torch.cat(scores), exact=True)
    of_mesh = torch.stack([part.sum() for part in share.split([len(one) for one in scores])])
    any_right = max(sum(one.probabilities) for one in found)
    every = torch.zeros(len(results), dtype=torch.float64)
    every[torch.tensor(posed)] = any_right * of_mesh
    own = sum(found[best].probabilities)
    factor = float(any_right * of_mesh[best]) / max(own, 1e-12)
    return replace(
        found[best].scaled(factor),
        mesh_index=posed[best],
        mesh_probabilities=tuple(every.tolist()),
    )


def _rival_scores(result: Registration, weights: EvidenceWeights) -> Tensor:
    """(R,) scores of the poses of one mesh that have a probability, the best first."""
    rivals = [
        hypothesis.evidence
        for hypothesis, probability in zip(result.hypotheses, result.probabilities, strict=True)
        if probability > 0.0
    ]
    evidence = Evidence.of_hypotheses(rivals or [result.hypotheses[0].evidence])
    return evidence.scores(weights)


def _compared_in_detail(
    scores: Sequence[Tensor],
    found: Sequence[Registration],
    targets: Sequence[Target],
    item: Photograph,
) -> list[Tensor]:
    """The scores of each mesh's poses, moved by how far the contours that only its best pose
    predicts speak for it, beside the best mesh."""
    first = max(range(len(scores)), key=lambda k: float(scores[k].max()))
    behind = [float(scores[first].max() - one.max()) for one in scores]
    if found[first].edge_support is None:
        return list(scores)
    chosen = [k for k, gap in enumerate(behind) if k == first or gap < DETAILED]
    if len(chosen) == 1:
        return list(scores)
    try:
        details = [_details_of(targets[k], found[k], item) for k in chosen]
    except CurviregError:  # a box that leaves nothing to compare
        return list(scores)
    gain, _ = compared(joined(details))
    place = chosen.index(first)
    moved = list(scores)
    for row, k in enumerate(chosen):
        moved[k] = scores[k] + gain[row, place]
    return moved


def _details_of(target: Target, result: Registration, item: Photograph) -> ContourDetails:
    """What the contours of a mesh's best pose are compared by, in the box of the photograph that
    was given, or in which the object was found."""
    box = item.box if result.detection is None else result.detection.box.float()
    crops = EdgeCrops.cut([item.image], box[None], target.bank.settings.margin)
    T, K = result.projection
    index = torch.zeros(1, dtype=torch.long)
    return contour_details(target.describer.contours, crops, K[None], T[None], index)


def joined(details: Sequence[ContourDetails]) -> ContourDetails:
    """Details of several meshes in one table; those with fewer points get invalid ones."""
    most = max(one.uv.shape[1] for one in details)

    def filled(values: Tensor) -> Tensor:
        missing = most - values.shape[1]
        shape = (len(values), missing, *values.shape[2:])
        return torch.cat([values, values.new_zeros(shape)], dim=1)

    columns = {
        field.name: torch.cat([filled(getattr(one, field.name)) for one in details])
        for field in fields(ContourDetails)
    }
    return ContourDetails(**columns)
