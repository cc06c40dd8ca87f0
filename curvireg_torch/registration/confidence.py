"""Probabilities that a pose or a detection is right: logistic models of measured features.

Two models serve registrations: "instance", for the mesh of this very object, and "category", for
the mesh of another object of its kind. Their constants, and those of refinement, tracking and
detection, were fitted by scripts/calibration on generated photographs; docs/accuracy.md has their
accuracy on others.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..calibration import CALIBRATION
from ..evidence import Evidence
from ..geometry.viewpoint import angles_between
from ..mesh.symmetry import ROUND
from ..pipeline import BankSettings, FitSettings, Pipeline

# Probability that the object is where keypoints agree on a pose, in a whole photograph: on
# generated shelves 84 of 88. It is less where other objects have a similar print
KEYPOINT_PROBABILITY = 0.95
RELIABLE = FitSettings().reliable  # Confidence from which an answer is called reliable by default
# the more, the better
EVIDENCE_FEATURES = (
    "similarity",
    "margin",
    "edge_support",
    "contours",
    "ranking_share",
    "keypoints",
)
DOUBT_FEATURES = ("unmatched", "undetermined", "outside", "border", "focal")  # the more, the worse
CONFIDENCE_FEATURES = (*EVIDENCE_FEATURES, *DOUBT_FEATURES)
MAX_MARGIN = 5.0  # Margins are clamped to +- this value
UNCOMPARED_CONFIDENCE = 0.5  # Largest confidence in a result without rival views
RIVAL_ANGLE = 30.0  # Degrees beyond which two views are rivals
ROUNDING = 5e-4  # of these degrees: many views of a bank are 30 degrees apart

Features = Mapping[str, float | None]  # by name; None where there is no rival view to compare with


@dataclass(frozen=True)
class LogisticModel:
    """P = 1 / (1 + exp(-(bias + sum of weight x feature))), with weights by the names of
    features."""

    weights: Mapping[str, float]
    bias: float

    @classmethod
    def named(cls, name: str) -> "LogisticModel":
        """A model of :data:`CALIBRATION`."""
        return cls(CALIBRATION[name]["weights"], CALIBRATION[name]["bias"])

    def __call__(self, features: Features) -> float:
        """Probability in (0, 1); at most ``UNCOMPARED_CONFIDENCE`` if a feature is None, which
        counts as 0, a tie."""
        logit = self.bias + sum(
            weight * (features[name] or 0.0) for name, weight in self.weights.items()
        )
        # the logistic function, which overflows nowhere
        probability = 0.5 * (1.0 + math.tanh(0.5 * logit))
        return (
            probability
            if None not in features.values()
            else min(probability, UNCOMPARED_CONFIDENCE)
        )


def _model_name(*, exact: bool) -> str:
    """Which model serves: "instance" for the mesh of this very object and a known camera, else
    "category"."""
    return "instance" if exact else "category"


def is_calibrated(pipeline: Pipeline) -> bool:
    """Whether the models were fitted for such a pipeline: learned field, default terms, contour
    fit with its default settings, default views.

    The number of hypotheses, the box jitter, the size of the views, their spacing, how many of them
    the appearance term compares, and from where answers are called reliable may differ.
    """
    default = Pipeline()
    bank = pipeline.bank

    def compared(pipeline: Pipeline) -> Any:
        terms = [
            (term.name, term.weight, getattr(term, "whitening", None)) for term in pipeline.terms
        ]
        return pipeline.field, pipeline.weights, terms

    fit = replace(pipeline.fit, reliable=default.fit.reliable)
    usual = bank == BankSettings(image_size=bank.image_size) and fit == default.fit
    return usual and pipeline.contours and compared(pipeline) == compared(default)


def probability_of_any(features: Features, *, exact: bool) -> float:
    """Probability that one of the hypotheses is within 30 degrees of the truth, from
    :func:`confidence_features`."""
    return LogisticModel.named(_model_name(exact=exact))(features)


def refinement_confidence(features: Features) -> float:
    """Probability that a pose refined from a good start is within 10 degrees and 10 % of the
    distance of the truth, from its ``similarity`` and ``edge_support``."""
    return LogisticModel.named("refinement")(features)


def tracking_confidence(features: Features) -> float:
    """Probability that a tracked pose is within 10 degrees and 10 % of the distance of the truth,
    if it was before, from the features of :class:`.TrackedPose`."""
    model = LogisticModel.named("tracking")
    return model({name: features[name] for name in model.weights})


def detection_probability(
    response: float, similarity: float, *, rival: float | None = None
) -> float:
    """Probability that a photograph shows the object in a box.

    Args:
        response: the detector's, of the box.
        similarity: normalised correlation of the box's best view.
        rival: where keypoints led to the box, whose number is the response, the largest number at
            another place.

    Example:
        >>> detection_probability(8.0, 0.9) > detection_probability(4.0, 0.6)
        True
    """
    if rival is not None:
        return KEYPOINT_PROBABILITY * response / (response + 0.5 * rival)
    return LogisticModel.named("detection")({"response": response, "similarity": similarity})


def are_near(rotations: Tensor, rotation: Tensor, symmetries: Tensor | None = None) -> Tensor:
    """(N,) bool: rotations (N, 3, 3) within ``RIVAL_ANGLE`` of one (3, 3), or of what a symmetry
    makes of it.

    ``symmetries`` are (K, 4, 4) or (K, 3, 3).
    """
    angles = angles_between(rotation[None].to(rotations), rotations, symmetries)[0]
    return angles <= RIVAL_ANGLE + ROUNDING


def ranking_share(scores: Tensor, near: Tensor) -> float | None:
    """Fraction of the sum of S^4 over all views (N,) that the views ``near`` (N,) a pose have; None
    if all are near.

    Example:
        >>> import torch
        >>> round(ranking_share(torch.tensor([1.0, 0.5]), torch.tensor([True, False])), 4)
        0.9412
    """
    scores = scores.double()
    weights = (scores / scores.max().clamp(min=1e-300)) ** 4  # all scores may be 0
    return (
        None
        if bool(near.all())
        else float((weights * near).sum() / weights.sum().clamp(min=1e-300))
    )


def undetermined_axes(covariance: Tensor, symmetries: Tensor | None = None) -> float:
    """How many axes of rotation a fit leaves undetermined, in [0, 3]: the sum of the standard
    deviations in radians about the three principal axes of the rotation's covariance, each at most
    1. 3 without a covariance (6, 6): one that is NaN. The axis of a body of revolution, whose
    ``symmetries`` (S, 4, 4) are many, need not be determined.

    Example:
        >>> import torch
        >>> round(undetermined_axes(torch.diag(torch.tensor([0.01, 0.04, 9.0, 1.0, 1.0, 1.0]))), 3)
        1.3
    """
    rotation = covariance[:3, :3]
    if not bool(rotation.isfinite().all()):
        return 3.0
    deviations = torch.linalg.eigvalsh(rotation.double()).clamp(min=0.0).sqrt()
    undetermined = float(deviations.clamp(max=1.0).sum())
    return max(undetermined - 1.0, 0.0) if is_round(symmetries) else undetermined


def is_round(symmetries: Tensor | None) -> bool:
    """Whether these (S, 4, 4) are the symmetries of a body of revolution."""
    return symmetries is not None and len(symmetries) >= ROUND


def confidence_features(
    evidence: Evidence,
    scores: Tensor,
    share: float | None,
    *,
    printed: float,
    undetermined: float,
    outside: float,
    border: float,
    focal: float = 0.0,
) -> dict[str, float | None]:
    """``CONFIDENCE_FEATURES`` of the best hypothesis of one photograph.

    similarity, edge_support, contours, keypoints: of the best hypothesis. margin: its score minus
    the largest of its rivals, clamped to +-5; None without rivals. unmatched: by how much
    ``printed`` exceeds its keypoints: a print that the photograph does not show speaks against an
    answer, and a mesh without print has none to find.

    Args:
        evidence: of the H hypotheses, the best first.
        scores: (H,) theirs, without keypoints, which a similar print beside the object has too.
        share: :func:`ranking_share` of the ranking.
        printed: log (1 + n) with the number n of keypoints that a view of the mesh has; 0 where
            keypoints are not looked for, as with a mesh without colours.
        undetermined: :func:`undetermined_axes` of the best hypothesis.
        outside: fraction of the object that lies outside the photograph.
        border: number of the box's sides that lie on the border of the photograph.
        focal: standard deviation of the focal length, as a fraction of it; larger ones than 1 count
            as 1.
    """
    best = evidence.named(0)
    rivals = scores[1:]
    margin = (
        min(max(float(scores[0] - rivals.max()), -MAX_MARGIN), MAX_MARGIN) if len(rivals) else None
    )
    return {
        "similarity": best["similarity"],
        "margin": margin,
        "edge_support": best["edge_support"],
        "contours": best["contours"],
        "ranking_share": share,
        "keypoints": best["keypoints"],
        "unmatched": max(printed - best["keypoints"], 0.0),
        "undetermined": undetermined,
        "outside": outside,
        "border": border,
        "focal": min(focal, 1.0),
    }


def resolution() -> float:
    """Difference of two scores up to which a photograph does not tell which of two poses of an
    exact mesh is right."""
    return float(CALIBRATION["instance"]["resolution"])


def shares(scores: Tensor, *, exact: bool) -> Tensor:
    r"""(H,) probability of each hypothesis to be the right one, if one of them is, from their
    scores (H,).

    In proportion to :math:`e^{-a \max(0, s - s_k - r)}` with the best score s and the slope a:
    scores that differ by less than the resolution r, as the fits of two equally good poses do, are
    a tie, whose members have equal shares.

    Args:
        scores: by which hypotheses are ordered.
        exact: see :func:`_model_name`.

    Example:
        >>> import torch
        >>> shares(torch.tensor([3.0, 3.0]), exact=True).tolist()
        [0.5, 0.5]
    """
    constants = CALIBRATION[_model_name(exact=exact)]
    behind = scores.double().max() - scores.double() - constants["resolution"]
    logits: Tensor = -constants["slope"] * behind.clamp(min=0.0)
    return logits.softmax(dim=0)


def hypothesis_probabilities(any_right: float, scores: Tensor, *, exact: bool) -> tuple[float, ...]:
    """Probability of each hypothesis of one photograph to be within 30 degrees of the truth: the
    probability that any of them is, times their :func:`shares`. Of two poses that fit equally well,
    neither has more than one half.

    Example:
        >>> import torch
        >>> hypothesis_probabilities(0.9, torch.tensor([3.0, 3.0]), exact=True)
        (0.45, 0.45)
    """
    return tuple((any_right * shares(scores, exact=exact)).tolist())


def two_decimals(probability: float) -> str:
    """A probability as it is shown, never rounded up: 0.897 is not yet 0.90, reliable.

    Example:
        >>> two_decimals(0.897), two_decimals(0.29), two_decimals(1.0)
        ('0.89', '0.29', '1.00')
    """
    return f"{math.floor(100.0 * probability + 1e-9) / 100.0:.2f}"
