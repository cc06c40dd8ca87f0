"""Answers that count as one: all turns about a known axis, or two poses that are each other's half
turn or mirror image.

Where a photograph does not tell several poses apart, none of them is probable, though what they
have in common may be certain. The probability of a group is computed as that of one pose is: with
the margin to the best pose outside the group, and the share that its views have in the ranking.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..mesh.round_axis import RoundAxis
from .confidence import (
    MAX_MARGIN,
    RIVAL_ANGLE,
    ROUNDING,
    are_near,
    probability_of_any,
    ranking_share,
    shares,
)

AXIS_TOLERANCE = 15.0
"""Degrees within which two axes are the same answer."""


@dataclass(frozen=True)
class Axis:
    """Where the axis of a nearly round object points, whatever its turn about it.

    Attributes:
        direction: (3,) float64 unit vector in the frame of the pose's rotation.
        probability: that it is within ``tolerance_deg`` of the truth.
        tolerance_deg: degrees.

    Example:
        >>> axis = Axis(torch.tensor([0.0, 0.0, 1.0]), 0.95)
        >>> axis.to_dict()
        {'direction': [0.0, 0.0, 1.0], 'probability': 0.95, 'tolerance_deg': 15.0}
    """

    direction: Tensor
    probability: float
    tolerance_deg: float = AXIS_TOLERANCE

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {**vars(self), "direction": self.direction.tolist()}


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
