"""The answer set: the poses that may be right, with probabilities, and the smallest set that holds the truth."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from ..geometry.viewpoint import rotation_error

__all__ = ["LEVEL", "AnswerSet", "ambiguity", "answer_set"]

LEVEL = 0.9
"""Fraction of photographs whose answer set holds the truth."""

HALF_TURN = 150.0
"""Degrees from which the rotation between two poses counts as a half turn."""

MIRRORED = 30.0
"""Degrees within which two directions of view count as mirror images of each other."""


@dataclass(frozen=True)
class AnswerSet:
    """Probabilities of the reported poses, and the smallest set of answers that holds the truth with ``LEVEL``.

    The truth is the pose within 30 degrees of the true one, or "none of them" where no reported pose is. The set holds
    the best pose, and of the other answers the most probable ones until their probabilities add up to ``threshold``,
    which split-conformal calibration chose such that ``LEVEL`` of the sets hold the truth (docs/method.md).

    Attributes:
        probabilities: of the hypotheses to be within 30 degrees of the truth, in their order.
        threshold: sum of probabilities at which the set is complete.

    Example:
        >>> answers = AnswerSet((0.5, 0.1, 0.3), threshold=0.7)
        >>> answers.members, round(answers.none, 6), answers.holds_none
        ((0, 2), 0.1, False)
    """

    probabilities: tuple[float, ...]
    threshold: float = LEVEL

    @property
    def none(self) -> float:
        """Probability of "none of them"."""
        return max(0.0, 1.0 - sum(self.probabilities))

    @cached_property
    def members(self) -> tuple[int, ...]:
        """Indices of the hypotheses in the set, the best pose first, then by probability."""
        return tuple(answer for answer in self._answers if answer < len(self.probabilities))

    @property
    def holds_none(self) -> bool:
        """Whether "none of them" is in the set."""
        return len(self.probabilities) in self._answers

    @cached_property
    def candidates(self) -> tuple[tuple[int, float], ...]:
        """All answers in the order in which they enter the set, each with the sum of the probabilities before it.

        "None of them" has the index after that of the last hypothesis.
        """
        probabilities = [*self.probabilities, self.none]
        order = [0, *sorted(range(1, len(probabilities)), key=lambda a: -probabilities[a])]
        before = accumulate((probabilities[answer] for answer in order), initial=0.0)
        return tuple(zip(order, before, strict=False))

    @cached_property
    def _answers(self) -> list[int]:
        """Indices of the answers in the set."""
        return [answer for answer, before in self.candidates if answer == 0 or before < self.threshold]

    def scaled(self, factor: float) -> "AnswerSet":
        """The answers if the object is there with probability ``factor``."""
        return replace(self, probabilities=tuple(p * factor for p in self.probabilities))

    def to_dict(self) -> dict[str, Any]:
        """As JSON values, under the keys of ``result.json`` (docs/results.md)."""
        return {
            "level": LEVEL,
            "members": list(self.members),
            "holds_none": self.holds_none,
            "probabilities": list(self.probabilities),
            "none": self.none,
        }


def answer_set(
    confidence: float, scores: Tensor, constants: Mapping[str, float], *, reported: int | None = None
) -> AnswerSet:
    r"""Answers of one photograph, the probability of whose first hypothesis is known.

    If the first is wrong, rival :math:`k` is right with a probability in proportion to :math:`e^{a (s_k - s_1)}`, s_1
    being the score of the best rival, and none of them in proportion to :math:`e^b`.

    Args:
        confidence: probability that the first hypothesis is right.
        scores: (H,) of :func:`rescore`, the first hypothesis first.
        constants: ``slope`` a, ``none`` b and ``threshold``, calibrated for each ``model_name``.
        reported: number of hypotheses that are reported; the others count as none of them.
    """
    rivals = scores[1:].double()
    rivals = constants["slope"] * (rivals - rivals.max()) if len(rivals) else rivals
    logits = torch.cat([rivals, torch.tensor([constants["none"]], dtype=torch.float64)])
    others = ((1.0 - confidence) * logits.softmax(dim=0))[:-1].tolist()
    return AnswerSet((confidence, *others)[:reported], constants["threshold"])


def ambiguity(rotations: Tensor) -> str | None:
    """How poses differ, in words; None for a single one.

    "half turn": the second differs from the first by a rotation of nearly 180 degrees. "mirror": they are seen from
    directions that are mirror images at a coordinate plane of the mesh. "several": anything else, or more than two.

    Args:
        rotations: (K, 3, 3).

    Example:
        >>> ambiguity(torch.stack([torch.eye(3), torch.diag(torch.tensor([-1.0, -1.0, 1.0]))]))
        'half turn'
    """
    if len(rotations) < 2:
        return None
    if len(rotations) > 2:
        return "several"
    first, second = rotations.double()
    if float(rotation_error(first, second)) >= HALF_TURN:
        return "half turn"
    mirrored = first[2] * (1.0 - 2.0 * torch.eye(3, dtype=torch.float64))  # the optical axis at the three planes
    angles = torch.rad2deg((mirrored @ second[2]).clamp(-1.0, 1.0).acos())
    return "mirror" if float(angles.min()) <= MIRRORED else "several"
