"""How far a ranking, a pose or a place can be trusted: logistic models of what was measured.

Their constants are those of :mod:`curvireg_torch.registration.calibration`. What they are worth on photographs that had
no part in them is in docs/accuracy.md.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..matching import Ranking
from .calibration import CALIBRATION
from .rescoring import POSE_FEATURES

__all__ = [
    "FEATURES",
    "PRESENCE_FEATURES",
    "RELIABLE",
    "LogisticModel",
    "confidence",
    "confidence_model",
    "pose_features",
    "presence",
    "presence_features",
    "ranking_evidence",
    "ranking_features",
]

RELIABLE = 0.9
"""Confidence below which a registration says "no reliable match"."""

RANKING_FEATURES = ("similarity", "margin", "concentration")
"""What :func:`ranking_evidence` measures, in its order."""

FEATURES = ("similarity", "lead", "edge_support", "appearance_lead", "concentration")
"""What the confidence in a pose that was followed to its end rests on, see :func:`pose_features`."""

PRESENCE_FEATURES = ("place", "similarity")
"""What :func:`presence_features` measures, in its order; similarity alone where nothing was learnt."""

_PRESENCE = {2: ((1.128, 7.819), -16.897), 1: ((16.756,), -14.856)}
"""Logistic regressions on mosaics of photographs of textured meshes, by scripts/speed/location.py: weights and bias for
both pieces of evidence, and for the one."""

MARGIN = 5.0
"""A lead that is larger says no more."""

UNCOMPARED = 0.5
"""Confidence in an answer that has no rival, at most."""

_APART = 30.0  # degrees beyond which two views are rival answers

Features = Mapping[str, float | None]
"""By name; None where there is no rival view to compare with."""


@dataclass(frozen=True)
class LogisticModel:
    """P = 1 / (1 + exp(-(bias + sum of weight x feature))).

    Attributes:
        weights: of the features, by name.
        bias: where all features are 0.
    """

    weights: Mapping[str, float]
    bias: float

    def __call__(self, features: Features) -> float:
        """Probability in (0, 1).

        A feature that is None, for want of a rival to compare with, counts as 0, as that of a tie does, and the
        probability is ``UNCOMPARED`` at most: nothing was seen that speaks against another pose.
        """
        logit = self.bias + sum(weight * (features[name] or 0.0) for name, weight in self.weights.items())
        probability = 0.5 * (1.0 + math.tanh(0.5 * logit))  # the logistic function, which overflows nowhere
        return probability if None not in features.values() else min(probability, UNCOMPARED)


def confidence_model(stage: str, *, with_camera: bool, with_appearance: bool) -> LogisticModel:
    """The model of one way to register.

    Args:
        stage: "ranking" of answers that are views, "contours" of poses that were followed to their end.
        with_camera: whether the camera matrix is known, and with it, as a rule, the object's own mesh. A ranking does
            not depend on it.
        with_appearance: whether the pipeline has the appearance term.
    """
    camera = [] if stage == "ranking" else ["camera" if with_camera else "no camera"]
    name = ", ".join([stage, *camera, "appearance" if with_appearance else "no appearance"])
    model = CALIBRATION["confidence"][name]
    return LogisticModel(model["weights"], model["bias"])


def ranking_evidence(
    ranking: Ranking, rotations: Tensor, *, answer: Tensor | None = None, symmetries: Tensor | None = None
) -> Tensor:
    """(B, 3) numbers that tell right answers from wrong ones, by the names in ``RANKING_FEATURES``.

    similarity: normalised correlation of the answer's view, in [0, 1]. margin: how far its score leads the best view
    more than 30 degrees away, log S - log S', within +-5. concentration: of the sum of S^4 over all views, the share
    within 30 degrees of it. Both are NaN where no view is that far away: then nothing was compared.

    Args:
        ranking: of N views for B photographs.
        rotations: (N, 3, 3) of the views.
        answer: (B,) views that are the answers; default the best of each ranking.
        symmetries: (K, 4, 4) or (K, 3, 3) of the mesh: views that differ by one of them are the same answer.
    """
    scores = ranking.scores.double()
    best = ranking.order[:, :1] if answer is None else answer.to(ranking.order)[:, None]
    turns = torch.eye(3)[None] if symmetries is None else symmetries[:, :3, :3]
    alike = rotations[best] @ turns.to(rotations)  # (B, K, 3, 3)
    traces = (alike.flatten(2) @ rotations.flatten(1).T).amax(dim=1)
    near = traces >= 1.0 + 2.0 * math.cos(math.radians(_APART)) - 1e-5
    tiny = 1e-300  # of scores that are all 0
    leader = scores.gather(1, best).clamp(min=tiny)
    rival = scores.masked_fill(near, 0.0).amax(dim=1, keepdim=True)
    margin = (leader / rival.clamp(min=tiny)).log().clamp(-MARGIN, MARGIN)
    weights = (scores / scores.amax(dim=1, keepdim=True).clamp(min=tiny)) ** 4
    concentration = (weights * near).sum(dim=1, keepdim=True) / weights.sum(dim=1, keepdim=True).clamp(min=tiny)
    alone = near.all(dim=1, keepdim=True)
    parts = [ranking.hog.gather(1, best), *(x.masked_fill(alone, torch.nan) for x in (margin, concentration))]
    return torch.cat([part.double() for part in parts], dim=1).float()


def ranking_features(evidence: Tensor) -> dict[str, float | None]:
    """Features of one ranking, from (3,) :func:`ranking_evidence`; None for what could not be compared."""
    known = zip(RANKING_FEATURES, evidence.tolist(), strict=True)
    return {name: None if math.isnan(value) else value for name, value in known}


def confidence(ranking: Ranking, rotations: Tensor, *, symmetries: Tensor | None = None) -> Tensor:
    """Probability that the best view is within 30 degrees of the truth, from :func:`ranking_evidence`.

    Args:
        ranking: of N views for B photographs.
        rotations: (N, 3, 3) of the views.
        symmetries: see :func:`ranking_evidence`.

    Returns:
        (B,) in (0, 1).

    Example:
        >>> one = torch.tensor([[1.0, 0.0]])
        >>> R = torch.stack([torch.eye(3), torch.diag(torch.tensor([1.0, -1.0, -1.0]))])
        >>> clear, tied = (Ranking(s, torch.tensor([[0, 1]]), {"hog": 0.9 * s}) for s in (one, torch.ones(1, 2)))
        >>> bool(confidence(clear, R) > confidence(tied, R))
        True
    """
    model = confidence_model("ranking", with_camera=False, with_appearance="appearance" in ranking.terms)
    evidence = ranking_evidence(ranking, rotations, symmetries=symmetries)
    return torch.tensor([model(ranking_features(one)) for one in evidence])


def pose_features(evidence: Tensor, verdicts: Tensor, concentration: float | None) -> dict[str, float | None]:
    """Features of the best of the hypotheses that were followed for one photograph, by the names in ``FEATURES``.

    similarity and support: of the best one. lead: how far it leads its best rival in :func:`rescore`;
    appearance_lead: how much more it looks like the photograph than any rival. Leads are at most 5, and None where
    there is no rival. concentration: of the ranking, see :func:`ranking_evidence`.

    Args:
        evidence: (H, 4) of the hypotheses, see :data:`POSE_FEATURES`, the best first.
        verdicts: (H,) of the same.
        concentration: of the ranking.
    """
    best = dict(zip(POSE_FEATURES, evidence[0].tolist(), strict=True))
    appearance_scores = evidence[:, POSE_FEATURES.index("appearance")]
    return {
        "similarity": best["similarity"],
        "lead": _lead(verdicts),
        "edge_support": best["edge_support"],
        "appearance_lead": _lead(appearance_scores),
        "concentration": concentration,
    }


def _lead(values: Tensor) -> float | None:
    """How far the first is above the largest of the others, within +-``MARGIN``."""
    return float((values[0] - values[1:].max()).clamp(-MARGIN, MARGIN)) if len(values) > 1 else None


def presence_features(score: float, ranking: Ranking, *, pictures: bool) -> list[float]:
    """Numbers that tell whether the object is there at all (``PRESENCE_FEATURES``).

    Args:
        score: of the locator for the box.
        ranking: of the one box; its best raw correlation counts.
        pictures: whether the locator looked at pictures; where it compared fields its score tells nothing.
    """
    similarity = float(ranking.hog.detach().max())
    return [score, similarity] if pictures else [similarity]


def presence(evidence: Sequence[float]) -> float:
    """Probability that the photograph shows the object where its pose was found, from :func:`presence_features`.

    Example:
        >>> presence([8.0, 0.9]) > presence([4.0, 0.6])
        True
        >>> presence([0.9]) > presence([0.6])
        True
    """
    weights, bias = _PRESENCE[len(evidence)]
    names = PRESENCE_FEATURES[-len(evidence) :]
    model = LogisticModel(dict(zip(names, weights, strict=True)), bias)
    return model(dict(zip(names, evidence, strict=True)))
