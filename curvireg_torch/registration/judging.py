"""Judgement of the fitted poses of one photograph: their order, their probabilities, and what is
questionable."""

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
from .hypotheses import Hypotheses, hypothesis_of
from .inputs import ImageItem
from .result import FailedRegistration, Registration
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
    if is_calibrated(target.pipeline):
        any_right = probability_of_any(measured, exact=block.exact)
        every = hypothesis_probabilities(any_right, scores[rivals], exact=block.exact)
        probabilities = (*every, *[0.0] * (len(own) - len(rivals)))[: len(reported)]
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
        reliable_from=target.pipeline.fit.reliable,
    )


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


def better_of(
    one: Registration | FailedRegistration,
    rival: Registration | FailedRegistration,
    mesh_index: int,
) -> Registration | FailedRegistration:
    """The registration with more confidence, or with a higher score where there is none;
    ``mesh_index`` is the rival's."""
    if not isinstance(rival, Registration):
        return one
    if not isinstance(one, Registration):
        return replace(rival, mesh_index=mesh_index)
    ahead = (rival.confidence or 0.0, rival.score) > (one.confidence or 0.0, one.score)
    return replace(rival, mesh_index=mesh_index) if ahead else one
