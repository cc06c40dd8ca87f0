"""The results of a registration."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ..errors import CurviregError
from ..geometry.cameras import transform
from ..geometry.pose_prior import PosePrior
from ..geometry.viewpoint import viewpoint_from_rotation
from ..matching import Ranking
from .answer_set import AnswerSet, ambiguity
from .calibration import SQUARED_RADIUS
from .confidence import RELIABLE

__all__ = ["FailedRegistration", "Hypothesis", "Localization", "Registration"]

UNKNOWN_ROTATION = 1.0
"""Radians of standard deviation from which the rotation about an axis counts as unknown."""


@dataclass(frozen=True)
class Hypothesis:
    """One candidate pose of the object, in the mesh file's own frame and unit.

    Attributes:
        rotation: (3, 3) float64, ``x_cam = R x_model + t``, OpenCV camera.
        translation: (3,) float64 in model units, None without a camera matrix.
        score: normalised correlation of photograph and rendered view in [0, 1]; of a tracked pose, how clearly and how
            near to its outline the object's colours end.
        evidence: the features that the hypotheses are ordered by, see :data:`.rescoring.POSE_FEATURES`; of a tracked
            pose, those of its confidence.
        allocentric_rotation: (3, 3) float64, relative to a camera that looks straight at the object.
        distance: distance of the object's centre in model units.
        projection: (4, 4) ``T_cam_from_model`` and (3, 3) camera matrix in px, float64, which project the mesh onto
            the photograph; without a camera matrix, those of a camera that looks straight at the object.
        view: index of the bank's view that the hypothesis started from.
        model: index of the mesh in the bank.
        edge_support: strength of the image edges under the projected contours, in [0, 1]; None without contour fit.
        covariance: (6, 6) float64 of rotation (rad) about the camera's x, y, z axes and translation (model units) along
            them, ``R_true = exp([w]x) R``, ``t_true = t + e``, if this is the right pose; None without a camera matrix,
            without contour fit, and where too few edges were found. Errors have heavier tails than a Gaussian, see
            :data:`curvireg_torch.registration.calibration.SQUARED_RADIUS`.
    """

    rotation: Tensor
    translation: Tensor | None
    score: float
    evidence: Mapping[str, float]
    allocentric_rotation: Tensor
    distance: float
    projection: tuple[Tensor, Tensor]
    view: int
    model: int = 0
    edge_support: float | None = None
    covariance: Tensor | None = None

    @property
    def viewpoint(self) -> tuple[float, float, float]:
        """Azimuth, elevation and theta of ``rotation`` in degrees (PASCAL3D+)."""
        azimuth, elevation, theta = viewpoint_from_rotation(self.rotation)
        return float(azimuth), float(elevation), float(theta)

    @property
    def standard_deviations(self) -> tuple[Tensor, Tensor] | None:
        """(3,) degrees about and (3,) model units along the camera's axes; None without a covariance.

        ``inf`` marks what the contours do not determine: deviations from a radian, or from half the distance.
        """
        if self.covariance is None:
            return None
        rotation, translation = self.covariance.diagonal().sqrt().split(3)
        rotation = torch.where(rotation < UNKNOWN_ROTATION, torch.rad2deg(rotation), torch.inf)
        return rotation, torch.where(translation < 0.5 * self.distance, translation, torch.inf)

    @property
    def transform(self) -> Tensor | None:
        """(4, 4) float64 ``T_cam_from_model``, None without a camera matrix."""
        return None if self.translation is None else transform(self.rotation, self.translation)

    def pose_dict(self) -> dict[str, Any]:
        """``rotation``, ``translation`` and ``viewpoint`` as JSON values."""
        return {
            "rotation": self.rotation.tolist(),
            "translation": None if self.translation is None else self.translation.tolist(),
            "viewpoint": dict(zip(("azimuth", "elevation", "theta"), self.viewpoint, strict=True)),
        }


@dataclass(frozen=True)
class Localization:
    """Where the object was found in a photograph that came without a box.

    Attributes:
        box: (4,) float64 x0, y0, x1, y1 in px, around the projected mesh.
        presence: probability that the photograph shows the object there.
        score: the locator's score of the proposal that led here.
        boxes: (P, 4) float64, all proposals, the results' boxes first, with their ``scores`` (P,).
    """

    box: Tensor
    presence: float
    score: float
    boxes: Tensor
    scores: Tensor


@dataclass(frozen=True)
class Registration:
    """Poses of one object in one photograph, best first.

    The attributes of the best :class:`Hypothesis` (``rotation``, ``translation``, ``score``, ``viewpoint``, ...) are
    attributes of the registration too; ``covariance`` and ``standard_deviations`` are None where it is not reliable.

    Attributes:
        hypotheses: distinct poses, best first; all but the first are rivals, such as the pose seen from behind.
        answer_set: probability of each hypothesis to be within 30 degrees of the truth, times ``localization.presence``
            for an object without a box; and the smallest set of them that holds the truth nine times in ten.
        ranking: scores of the bank's views for this photograph (B = 1).
        confidence_features: what the confidence is computed from, see :func:`.confidence.confidence_features` and
            :func:`.confidence.ranking_evidence`; ``lead`` is None where the bank has no rival view.
        localization: where the object was found; None if its box was given.
        corrected_box: (4,) float64, the box that replaced a given one that did not fit the pose; else None.
        prior: the limits on the pose that were given.
        prior_contradiction: "better outside": views outside the limits match much better, or the box asks for a
            distance outside; "at the limit": the pose lies within a degree, or 1 % of the distance, of a limit. None
            otherwise.
        warnings: what is questionable about the box and the camera, in words; a result with one is not reliable.
    """

    hypotheses: tuple[Hypothesis, ...]
    answer_set: AnswerSet
    ranking: Ranking
    confidence_features: Mapping[str, float | None] = field(default_factory=dict)
    localization: Localization | None = None
    corrected_box: Tensor | None = None
    prior: PosePrior | None = None
    prior_contradiction: str | None = None
    warnings: tuple[str, ...] = ()

    ok = True
    """False of a :class:`FailedRegistration`."""

    @property
    def confidence(self) -> float:
        """Probability of the best pose, the first of ``answer_set.probabilities``."""
        return self.answer_set.probabilities[0]

    @property
    def ambiguous(self) -> str | None:
        """How the poses of the answer set differ: "half turn", "mirror" or "several"; None if it holds one pose."""
        members = [self.hypotheses[member].allocentric_rotation for member in self.answer_set.members]
        return ambiguity(torch.stack(members))

    @property
    def reliable(self) -> bool:
        """Whether the confidence is at least ``RELIABLE``, without ``warnings``, and the photograph does not contradict
        the prior by a better match outside; if False, the pose is a guess."""
        return self.confidence >= RELIABLE and not self.warnings and self.prior_contradiction != "better outside"

    @property
    def candidates(self) -> Tensor:
        """(K,) view indices of the hypotheses."""
        return torch.tensor([h.view for h in self.hypotheses])

    @property
    def rotation(self) -> Tensor:
        return self.hypotheses[0].rotation

    @property
    def translation(self) -> Tensor | None:
        return self.hypotheses[0].translation

    @property
    def score(self) -> float:
        return self.hypotheses[0].score

    @property
    def allocentric_rotation(self) -> Tensor:
        return self.hypotheses[0].allocentric_rotation

    @property
    def distance(self) -> float:
        return self.hypotheses[0].distance

    @property
    def projection(self) -> tuple[Tensor, Tensor]:
        return self.hypotheses[0].projection

    @property
    def model(self) -> int:
        return self.hypotheses[0].model

    @property
    def edge_support(self) -> float | None:
        return self.hypotheses[0].edge_support

    @property
    def covariance(self) -> Tensor | None:
        return self.hypotheses[0].covariance if self.reliable else None

    @property
    def viewpoint(self) -> tuple[float, float, float]:
        return self.hypotheses[0].viewpoint

    @property
    def standard_deviations(self) -> tuple[Tensor, Tensor] | None:
        return self.hypotheses[0].standard_deviations if self.reliable else None

    @property
    def transform(self) -> Tensor | None:
        return self.hypotheses[0].transform

    def pose_dict(self) -> dict[str, Any]:
        """:meth:`Hypothesis.pose_dict` of the best hypothesis."""
        return self.hypotheses[0].pose_dict()

    def to_dict(self) -> dict[str, Any]:
        """Pose, scores and uncertainty as JSON values, under the keys of ``result.json`` (docs/results.md)."""
        deviations, covariance = self.standard_deviations, self.covariance
        prior = None if self.prior is None else {**self.prior.to_dict(), "contradiction": self.prior_contradiction}
        return {
            **self.pose_dict(),
            "score": self.score,
            "confidence": self.confidence,
            "reliable": self.reliable,
            "warnings": list(self.warnings),
            "answer_set": self.answer_set.to_dict(),
            "ambiguous": self.ambiguous,
            "confidence_features": dict(self.confidence_features),
            "edge_support": self.edge_support,
            "standard_deviations": None
            if deviations is None
            else {"rotation_deg": _finite(deviations[0]), "translation": _finite(deviations[1])},
            "covariance": None if covariance is None else covariance.tolist(),
            "squared_radius": None if covariance is None else {f"{k:g}": r for k, r in SQUARED_RADIUS.items()},
            "corrected_box": None if self.corrected_box is None else self.corrected_box.tolist(),
            **({} if prior is None else {"prior": prior}),
            "top": [self._hypothesis_dict(hypothesis) for hypothesis in self.hypotheses],
        }

    def _hypothesis_dict(self, hypothesis: Hypothesis) -> dict[str, Any]:
        terms = {name: float(raw[0, hypothesis.view]) for name, raw in self.ranking.terms.items()}
        return {
            **hypothesis.pose_dict(),
            "score": hypothesis.score,
            "evidence": dict(hypothesis.evidence),
            "view": hypothesis.view,
            "terms": {name: value for name, value in terms.items() if math.isfinite(value)},
        }


def _finite(deviations: Tensor) -> list[float | None]:
    """JSON has no infinity: None in its place."""
    return [None if math.isinf(v) else v for v in deviations.tolist()]


@dataclass(frozen=True)
class FailedRegistration:
    """A photograph that could not be registered because of its ``error``, which access to a pose raises."""

    error: CurviregError

    ok = False

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise self.error
