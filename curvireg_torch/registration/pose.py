"""The result of a registration."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ..errors import CurviregError
from ..geometry.cameras import transform
from ..geometry.viewpoint import viewpoint_from_rotation
from ..matching import Ranking
from .confidence import RELIABLE

__all__ = ["FailedRegistration", "Hypothesis", "Localization", "Registration"]

UNKNOWN_TURN = 1.0
"""Radians of standard deviation from which a turn is not known at all."""


@dataclass(frozen=True)
class Hypothesis:
    """One pose of the object that the photograph may show, in the mesh file's own frame and unit.

    Attributes:
        rotation: (3, 3) float64, ``x_cam = R x_model + t``, OpenCV camera.
        translation: (3,) float64 in model units, None without a camera matrix.
        score: normalised correlation of the pose's view with the photograph, in [0, 1], on the grid of the search
            (twice as fine as the bank's) or, without search, of the bank.
        evidence: what the order of hypotheses rests on, by name, see :mod:`curvireg_torch.registration.rescoring`.
        allocentric_rotation: (3, 3) float64 of the same view by a camera that looks straight at the object; equal to
            ``rotation`` without a camera matrix.
        distance: of the object's centre in that view, in model units.
        seen_by: (4, 4) ``T_cam_from_model`` and (3, 3) camera matrix in px of the photograph, float64, that project the
            mesh onto the photograph as it was found. Without a camera matrix, that of the camera that was assumed: one
            that looks straight at the object.
        view: of the bank, where the hypothesis comes from.
        model: which of the bank's meshes.
        support: how strongly edges of the photograph lie under the mesh's contours, in [0, 1]; None without the contour
            stage (:func:`curvireg_torch.registration.fit_contours`).
        covariance: (6, 6) float64 of turn (rad) about the camera's x, y, z and translation (model units) along them,
            ``R_true = exp([w]x) R``, ``t_true = t + e``, should this pose be the right one; None without a camera
            matrix, without the contour stage, and where the contours do not fix the pose. Its errors have heavier
            tails than a Gaussian's: see :data:`curvireg_torch.registration.calibration.SQUARED_RADIUS`.
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
        """Azimuth, elevation, theta of ``rotation`` in degrees (PASCAL3D+)."""
        azimuth, elevation, theta = viewpoint_from_rotation(self.rotation)
        return float(azimuth), float(elevation), float(theta)

    @property
    def standard_deviations(self) -> tuple[Tensor, Tensor] | None:
        """(3,) degrees about and (3,) model units along the camera's axes; None without a covariance.

        ``inf`` where the contours do not tell: about an axis of symmetry, or a shift as large as half the distance.
        """
        if self.covariance is None:
            return None
        turn, shift = self.covariance.diagonal().sqrt().split(3)
        turn = torch.where(turn < UNKNOWN_TURN, torch.rad2deg(turn), torch.inf)
        return turn, torch.where(shift < 0.5 * self.distance, shift, torch.inf)

    @property
    def transform(self) -> Tensor | None:
        """(4, 4) float64 ``T_cam_from_model``, None without a camera matrix."""
        return None if self.translation is None else transform(self.rotation, self.translation)


@dataclass(frozen=True)
class Localization:
    """Where an object was found that came without a box.

    Attributes:
        box: (4,) float64 x0, y0, x1, y1 in px, around the pose.
        presence: probability that the photograph shows the object there, see
            :func:`curvireg_torch.registration.confidence.presence`.
        score: of the locator for the place it started from.
        boxes: (P, 4) float64 all places that were proposed, the answers first, with their ``scores`` (P,).
    """

    box: Tensor
    presence: float
    score: float
    boxes: Tensor
    scores: Tensor


@dataclass(frozen=True)
class Registration:
    """Poses of one object in one photograph, best first.

    Everything that a :class:`Hypothesis` has is here too, of the best one: ``rotation``, ``translation``, ``score``,
    ``viewpoint`` and so on; ``covariance`` and ``standard_deviations`` are None where the answer is not reliable.

    Attributes:
        hypotheses: distinct poses, best first; the others are rivals, such as half a turn.
        confidence: probability that the best is within 30 degrees of the truth, see
            :func:`curvireg_torch.registration.confidence`; of an object without a box, times the probability that it
            is there.
        ranking: of the bank's views for this photograph (B = 1).
        confidence_features: what the confidence rests on, by name, see :func:`.confidence.pose_features` and
            :func:`.confidence.ranking_evidence`; rivals that are not reported are included. ``lead`` is None where the
            bank has no view that could be a rival: then little confidence is given.
        found: of an object without a box.
        corrected_box: (4,) float64 the box that the answer was made with, where the given one did not fit.
    """

    hypotheses: tuple[Hypothesis, ...]
    confidence: float
    ranking: Ranking
    confidence_features: Mapping[str, float | None] = field(default_factory=dict)
    found: Localization | None = None
    corrected_box: Tensor | None = None

    ok = True
    """False of a :class:`FailedRegistration`."""

    @property
    def reliable(self) -> bool:
        """Whether the confidence is high enough; False = no reliable match: take the pose as a guess."""
        return self.confidence >= RELIABLE

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


@dataclass(frozen=True)
class FailedRegistration:
    """A photograph of a batch that could not be registered. Asked for a pose, it raises its error.

    Attributes:
        error: what was wrong with this photograph, its box or its camera.
    """

    error: CurviregError

    ok = False

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise self.error
