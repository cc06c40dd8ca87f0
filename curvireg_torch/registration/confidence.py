"""How far a ranking can be trusted, and its best distinct views."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ..geometry.viewpoint import rotation_error
from ..matching import Ranking

__all__ = [
    "EVIDENCE",
    "POSE_EVIDENCE",
    "RELIABLE",
    "confidence",
    "pose_confidence",
    "pose_evidence",
    "ranking_evidence",
]

EVIDENCE = ("similarity", "margin", "concentration")
"""What :func:`ranking_evidence` measures, in its order."""

RELIABLE = 0.6
"""Confidence below which a registration says "no reliable match"."""

_WEIGHTS = (9.513, 1.042, 2.375)
_BIAS = -8.803
"""Logistic regression on scenes made in code, by scripts/calibrate_confidence.py."""

_APART = 30.0  # degrees beyond which two views are rival answers


POSE_EVIDENCE = ("similarity", "support", "appearance", "margin", "concentration")
"""What :func:`pose_evidence` measures, in its order."""

_POSE_WEIGHTS = (2.0, 4.0, 0.3, 0.4, 1.0)
_POSE_BIAS = -4.0
"""Logistic regression on photographs of textured meshes, by scripts/fit_verdict.py."""

MARGIN = 5.0
"""A lead that is larger tells no more."""


def ranking_evidence(ranking: Ranking, rotations: Tensor) -> Tensor:
    """(B, 3) numbers that tell right answers from wrong ones, see :data:`EVIDENCE`.

    similarity: normalised correlation of the best view, in [0, 1]. margin: how far its score leads the best view more
    than 30 degrees away, log S - log S', at most 5. concentration: of the sum of S^4 over all views, the share within
    30 degrees of the best.

    Args:
        ranking: of N views for B photographs.
        rotations: (N, 3, 3) of the views.
    """
    scores, best = ranking.scores.double(), ranking.order[:, :1]
    near = rotation_error(rotations[best], rotations[None]) <= _APART
    tiny = 1e-300  # of scores that are all 0
    leader = scores.gather(1, best).clamp(min=tiny)
    rival = scores.masked_fill(near, 0.0).amax(dim=1, keepdim=True)
    margin = (leader / rival.clamp(min=tiny)).log().clamp(max=5.0)
    weights = (scores / leader) ** 4
    concentration = (weights * near).sum(dim=1, keepdim=True) / weights.sum(dim=1, keepdim=True).clamp(min=tiny)
    parts = [ranking.hog.gather(1, best), margin, concentration]
    return torch.cat([part.double() for part in parts], dim=1).float()


def probability(evidence: Tensor) -> Tensor:
    """(B,) in (0, 1) from (B, 3) evidence, the logistic function of :func:`confidence`."""
    return torch.sigmoid(evidence @ evidence.new_tensor(_WEIGHTS) + _BIAS)


def confidence(ranking: Ranking, rotations: Tensor) -> Tensor:
    """Probability that the best view is within 30 degrees of the truth, from :func:`ranking_evidence`.

    A logistic function whose constants were fitted on scenes made in code (scripts/calibrate_confidence.py), each with
    its own mesh. What it is worth on photographs, and against wrong meshes, is in ``docs/method.md``. An object with
    symmetries has several right answers, which look like doubt here; whitened descriptors have another similarity,
    which the constants do not know.

    Args:
        ranking: of N views for B photographs.
        rotations: (N, 3, 3) of the views.

    Returns:
        (B,) in (0, 1).

    Example:
        >>> one = torch.tensor([[1.0, 0.0]])
        >>> R = torch.stack([torch.eye(3), torch.diag(torch.tensor([1.0, -1.0, -1.0]))])
        >>> clear = Ranking(one, torch.tensor([[0, 1]]), {"hog": 0.9 * one})
        >>> bool(confidence(clear, R) > 0.9)
        True
    """
    return probability(ranking_evidence(ranking, rotations))


def pose_evidence(best: Mapping[str, float], lead: float, concentration: float) -> list[float]:
    """Numbers that tell right poses from wrong ones, see :data:`POSE_EVIDENCE`, of hypotheses followed to their end.

    similarity, support, appearance: of the best hypothesis (:data:`curvireg_torch.registration.verify.EVIDENCE`).
    margin: its lead, at most 5. concentration: of the ranking, see :func:`ranking_evidence`.

    Args:
        best: evidence of the best hypothesis.
        lead: how far its verdict leads that of the next distinct one.
        concentration: in [0, 1].
    """
    return [best["similarity"], best["support"], best["appearance"], min(lead, MARGIN), concentration]


def pose_confidence(evidence: Sequence[float]) -> float:
    """Probability that the best pose is within 30 degrees of the truth, from :func:`pose_evidence`.

    What it is worth on photographs, and against wrong meshes, is in ``docs/method.md``.

    Example:
        >>> pose_confidence([0.9, 0.7, 0.0, 5.0, 1.0]) > pose_confidence([0.5, 0.3, -2.0, 0.5, 0.2])
        True
    """
    values, weights = (torch.tensor(v, dtype=torch.float64) for v in (evidence, _POSE_WEIGHTS))
    return float(torch.sigmoid(values @ weights + _POSE_BIAS))
