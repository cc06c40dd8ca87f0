"""Judgement of the fitted poses of one photograph: their order, their probabilities, and what is
questionable."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from ..evidence import Evidence
from .block import Block
from .confidence import (
    are_near,
    confidence_features,
    hypothesis_probabilities,
    is_calibrated,
    probability_of_any,
    ranking_share,
    undetermined_axes,
)
from .framing import border_sides, outside_fraction, outside_warnings
from .groups import Axis, Rivals, axis_of, pair_probability
from .hypotheses import Hypotheses, hypothesis_of
from .inputs import ImageItem
from .result import Registration, ambiguity
from .target import Target

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
        poses: those in it; those that merged with a better one have returned to their views.
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
    with_camera = item.camera_matrix is not None
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
        camera=item.camera,
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
        has_camera = block.photographs[photograph].camera_matrix is not None
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


def _outside_fraction(target: Target, item: ImageItem, best: Hypotheses) -> float:
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
