"""Probabilities that a ranking, a pose or a localization is right: logistic models of measured features.

Their constants come from :mod:`curvireg_torch.registration.calibration`; docs/accuracy.md has their accuracy on
photographs that were not used for calibration.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..matching import Ranking
from .calibration import CALIBRATION, REFINEMENT, TRACKING

__all__ = [
    "CONFIDENCE_FEATURES",
    "PRESENCE_FEATURES",
    "RELIABLE",
    "LogisticModel",
    "confidence",
    "confidence_features",
    "confidence_model",
    "model_name",
    "presence",
    "presence_features",
    "ranking_evidence",
    "ranking_features",
]

RELIABLE = 0.9
"""Confidence from which a registration is called reliable."""

RANKING_FEATURES = ("similarity", "margin", "concentration")
"""Columns of :func:`ranking_evidence`."""

CONFIDENCE_FEATURES = ("similarity", "lead", "edge_support", "appearance_lead", "concentration")
"""Features of the confidence in a fitted pose, see :func:`confidence_features`."""

PRESENCE_FEATURES = ("proposal", "similarity")
"""Values of :func:`presence_features`; only the similarity for pipelines without anything learned."""

_PRESENCE = {2: ((1.128, 7.819), -16.897), 1: ((16.756,), -14.856)}
"""Weights and bias for two features and for one: logistic regressions on mosaics of photographs of textured meshes, by
scripts/calibration/calibrate.py."""

MARGIN = 5.0
"""Leads are clamped to +- this value."""

UNCOMPARED = 0.5
"""Largest confidence in a result without rival views."""

_APART = 30.0  # degrees beyond which two views are rivals

Features = Mapping[str, float | None]
"""Features by name; None where there is no rival view to compare with."""


@dataclass(frozen=True)
class LogisticModel:
    """P = 1 / (1 + exp(-(bias + sum of weight x feature))), with weights by the names of features."""

    weights: Mapping[str, float]
    bias: float

    def __call__(self, features: Features) -> float:
        """Probability in (0, 1); at most ``UNCOMPARED`` if a feature is None, which counts as 0, as in a tie."""
        logit = self.bias + sum(weight * (features[name] or 0.0) for name, weight in self.weights.items())
        probability = 0.5 * (1.0 + math.tanh(0.5 * logit))  # the logistic function, which overflows nowhere
        return probability if None not in features.values() else min(probability, UNCOMPARED)


def model_name(stage: str, *, exact: bool, with_appearance: bool) -> str:
    """The key of the calibrated constants for a kind of result.

    Args:
        stage: "ranking" for views, "contours" for fitted poses.
        exact: whether the mesh is that of this very object, or only of a similar one.
        with_appearance: whether the pipeline has the appearance term.
    """
    return f"{stage}, {'exact' if exact else 'similar'}, {'appearance' if with_appearance else 'no appearance'}"


def confidence_model(name: str) -> LogisticModel:
    """The logistic model for a kind of result, by its ``model_name``."""
    model = CALIBRATION["confidence"][name]
    return LogisticModel(model["weights"], model["bias"])


def refinement_confidence(features: Features) -> float:
    """Probability that a refined pose is within 10 degrees and 10 % of the distance of the truth.

    Args:
        features: ``similarity`` and ``edge_support`` of the pose.
    """
    return LogisticModel(REFINEMENT["weights"], REFINEMENT["bias"])(features)


def tracking_confidence(features: Features) -> float:
    """Probability that a tracked pose is within 10 degrees and 10 % of the distance of the truth.

    Args:
        features: of :class:`.tracking.TrackedPose`.
    """
    return LogisticModel(TRACKING["weights"], TRACKING["bias"])({name: features[name] for name in TRACKING["weights"]})


def ranking_evidence(
    ranking: Ranking, rotations: Tensor, *, answer: Tensor | None = None, symmetries: Tensor | None = None
) -> Tensor:
    """(B, 3) features that separate right from wrong results, in the order of ``RANKING_FEATURES``.

    similarity: normalised correlation of the result's view, in [0, 1]. margin: log S - log S' to the best view more
    than 30 degrees away, clamped to +-5. concentration: the fraction of the sum of S^4 over all views that lies within
    30 degrees of the result. The last two are NaN where no view is that far away.

    Args:
        ranking: of N views for B photographs.
        rotations: (N, 3, 3) of the views.
        answer: (B,) views that are the results; default the best of each ranking.
        symmetries: (K, 4, 4) or (K, 3, 3) of the mesh: views that differ by one of them count as the same.
    """
    scores = ranking.scores.double()
    best = ranking.order[:, :1] if answer is None else answer.to(ranking.order)[:, None]
    group = torch.eye(3)[None] if symmetries is None else symmetries[:, :3, :3]
    equivalent = rotations[best] @ group.to(rotations)  # (B, K, 3, 3)
    traces = (equivalent.flatten(2) @ rotations.flatten(1).T).amax(dim=1)
    near = traces >= 1.0 + 2.0 * math.cos(math.radians(_APART)) - 1e-5
    tiny = 1e-300  # all scores may be 0
    leader = scores.gather(1, best).clamp(min=tiny)
    rival = scores.masked_fill(near, 0.0).amax(dim=1, keepdim=True)
    margin = (leader / rival.clamp(min=tiny)).log().clamp(-MARGIN, MARGIN)
    weights = (scores / scores.amax(dim=1, keepdim=True).clamp(min=tiny)) ** 4
    concentration = (weights * near).sum(dim=1, keepdim=True) / weights.sum(dim=1, keepdim=True).clamp(min=tiny)
    alone = near.all(dim=1, keepdim=True)
    parts = [ranking.hog.gather(1, best), *(x.masked_fill(alone, torch.nan) for x in (margin, concentration))]
    return torch.cat([part.double() for part in parts], dim=1).float()


def ranking_features(evidence: Tensor) -> dict[str, float | None]:
    """Features by name of one ranking, from (3,) :func:`ranking_evidence`; None instead of NaN."""
    return {n: None if math.isnan(v) else v for n, v in zip(RANKING_FEATURES, evidence.tolist(), strict=True)}


def confidence(ranking: Ranking, rotations: Tensor, *, exact: bool = False, symmetries: Tensor | None = None) -> Tensor:
    """Probability that the best view is within 30 degrees of the truth, from :func:`ranking_evidence`.

    Args:
        ranking, rotations, symmetries: see :func:`ranking_evidence`.
        exact: whether the mesh is that of this very object, or only of a similar one.

    Returns:
        (B,) in (0, 1).

    Example:
        >>> one = torch.tensor([[1.0, 0.0]])
        >>> R = torch.stack([torch.eye(3), torch.diag(torch.tensor([1.0, -1.0, -1.0]))])
        >>> clear, tied = (Ranking(s, torch.tensor([[0, 1]]), {"hog": 0.9 * s}) for s in (one, torch.ones(1, 2)))
        >>> bool(confidence(clear, R) > confidence(tied, R))
        True
    """
    model = confidence_model(model_name("ranking", exact=exact, with_appearance="appearance" in ranking.terms))
    evidence = ranking_evidence(ranking, rotations, symmetries=symmetries)
    return torch.tensor([model(ranking_features(one)) for one in evidence])


def confidence_features(evidence: Tensor, scores: Tensor, concentration: float | None) -> dict[str, float | None]:
    """``CONFIDENCE_FEATURES`` of the best hypothesis of one photograph.

    similarity, edge_support: of the best hypothesis. lead, appearance_lead: its score, and its appearance score, minus
    the largest of its rivals, clamped to +-5; None without rivals. concentration: see :func:`ranking_evidence`.

    Args:
        evidence: (H, 4) :data:`POSE_FEATURES` of the hypotheses, the best first.
        scores: (H,) of :func:`rescore`.
        concentration: of the ranking.
    """
    _, similarity, edge_support, _ = evidence[0].tolist()
    values = (similarity, _lead(scores), edge_support, _lead(evidence[:, 3]), concentration)
    return dict(zip(CONFIDENCE_FEATURES, values, strict=True))


def _lead(values: Tensor) -> float | None:
    """The first value minus the largest of the others, clamped to +-``MARGIN``."""
    return float((values[0] - values[1:].max()).clamp(-MARGIN, MARGIN)) if len(values) > 1 else None


def presence_features(score: float, ranking: Ranking, *, learned: bool) -> list[float]:
    """``PRESENCE_FEATURES`` of a box: the locator's score, and the best correlation of its ranking (B = 1).

    The score of a locator that is not ``learned`` is not informative, and left out.
    """
    similarity = float(ranking.hog.detach().max())
    return [score, similarity] if learned else [similarity]


def presence(evidence: Sequence[float]) -> float:
    """Probability that the photograph shows the object, from :func:`presence_features`.

    Example:
        >>> presence([8.0, 0.9]) > presence([4.0, 0.6])
        True
    """
    weights, bias = _PRESENCE[len(evidence)]
    names = PRESENCE_FEATURES[-len(evidence) :]
    model = LogisticModel(dict(zip(names, weights, strict=True)), bias)
    return model(dict(zip(names, evidence, strict=True)))
