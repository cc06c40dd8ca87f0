"""How far a ranking can be trusted, and its best distinct views."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..geometry.viewpoint import rotation_error
from ..matching import Ranking

__all__ = [
    "EVIDENCE",
    "POSE_EVIDENCE",
    "PRESENCE_EVIDENCE",
    "RELIABLE",
    "confidence",
    "pose_confidence",
    "pose_evidence",
    "presence",
    "presence_evidence",
    "ranking_evidence",
]

EVIDENCE = ("similarity", "margin", "concentration")
"""What :func:`ranking_evidence` measures, in its order."""

RELIABLE = 0.8
"""Confidence below which a registration says "no reliable match"."""

_WEIGHTS = (9.513, 1.042, 2.375)
_BIAS = -8.803
"""Logistic regression on scenes made in code, by scripts/calibrate_confidence.py."""

_APART = 30.0  # degrees beyond which two views are rival answers


POSE_EVIDENCE = ("similarity", "margin", "camera", "support")
"""What :func:`pose_evidence` measures, in its order."""

_POSE_WEIGHTS = (3.216, 0.477, 0.529, 2.433)
_POSE_BIAS = -3.292
"""Logistic regression on photographs of textured meshes, one in ten with a wrong mesh, by scripts/fit_verdict.py."""

PRESENCE_EVIDENCE = ("place", "similarity")
"""What :func:`presence_evidence` measures, in its order; similarity alone where nothing was learnt."""

_PRESENCE = {2: ((1.128, 7.819), -16.897), 1: ((16.756,), -14.856)}
"""Logistic regressions on mosaics of photographs of textured meshes, by scripts/bench_location.py: weights and bias for
both pieces of evidence, and for the one."""

MARGIN = 5.0
"""A lead that is larger tells no more."""


def ranking_evidence(ranking: Ranking, rotations: Tensor) -> Tensor:
    """(B, 3) numbers that tell right answers from wrong ones, by the names in ``EVIDENCE``.

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


def pose_evidence(similarity: float, lead: float | None, *, with_camera: bool, support: float = 0.0) -> list[float]:
    """Numbers that tell right poses from wrong ones (``POSE_EVIDENCE``), of a hypothesis followed to its end.

    Args:
        similarity: normalised correlation of the pose's view with the photograph.
        lead: how far its verdict leads that of the best rival; at most 5 counts. None where the bank has no rival
            view: it counts as no lead at all, for nothing tells how much less another pose would fit.
        with_camera: whether the camera matrix is known, and with it, as a rule, the object's own mesh.
        support: strength of the photograph's edges under the pose's contours.
    """
    return [similarity, 0.0 if lead is None else min(lead, MARGIN), float(with_camera), support]


def pose_confidence(evidence: Sequence[float]) -> float:
    """Probability that the best pose is within 30 degrees of the truth, from :func:`pose_evidence`.

    What it is worth on photographs, and against wrong meshes, is in ``docs/method.md``.

    Example:
        >>> pose_confidence([0.9, 5.0, 1.0, 0.5]) > pose_confidence([0.5, 0.5, 1.0, 0.2])
        True
    """
    return _logistic(evidence, _POSE_WEIGHTS, _POSE_BIAS)


def presence_evidence(score: float, ranking: Ranking, *, pictures: bool) -> list[float]:
    """Numbers that tell whether the object is there at all (``PRESENCE_EVIDENCE``).

    Args:
        score: of the locator for the box.
        ranking: of the one box; its best raw correlation counts.
        pictures: whether the locator looked at pictures; where it compared fields its score tells nothing.
    """
    similarity = float(ranking.hog.detach().max())
    return [score, similarity] if pictures else [similarity]


def presence(evidence: Sequence[float]) -> float:
    """Probability that the photograph shows the object where its pose was found, from :func:`presence_evidence`.

    Example:
        >>> presence([8.0, 0.9]) > presence([4.0, 0.6])
        True
        >>> presence([0.9]) > presence([0.6])
        True
    """
    return _logistic(evidence, *_PRESENCE[len(evidence)])


def _logistic(evidence: Sequence[float], weights: Sequence[float], bias: float) -> float:
    x, w = (torch.tensor(v, dtype=torch.float64) for v in (evidence, weights))
    return float(torch.sigmoid(x @ w + bias))
