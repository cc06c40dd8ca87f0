"""The result of a registration."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry.viewpoint import viewpoint_from_rotation
from ..matching import Ranking
from .confidence import RELIABLE

__all__ = ["Registration"]


@dataclass(frozen=True)
class Registration:
    """Pose of one object in one photograph, in the mesh file's own frame and unit.

    Attributes:
        rotation: (3, 3) float64, ``x_cam = R x_model + t``, OpenCV camera.
        translation: (3,) float64 in model units, None without a camera matrix.
        score: normalised correlation of the pose's view with the photograph, in [0, 1], on the grid of the search
            (twice as fine as the bank's) or, without refinement, of the bank.
        confidence: probability that the best view is within 30 degrees of the truth, see
            :func:`curvireg_torch.registration.confidence`.
        ranking: of the bank's views for this photograph (B = 1).
        candidates: (K,) view indices of the best distinct hypotheses, best first.
        view_rotation: (3, 3) float64 of the same view by a camera that looks straight at the box; equal to ``rotation``
            without a camera matrix.
        view_distance: of the object's centre in that view, in model units.
        iterations: refinement rounds that were run; 0 without refinement.
        support: how strongly edges of the photograph lie under the mesh's contours, in [0, 1]; None without the contour
            stage (:func:`curvireg_torch.registration.fit_contours`).
        covariance: (6, 6) float64 of turn (rad) about the camera's x, y, z and translation (model units) along them,
            ``R_true = exp([w]x) R``, ``t_true = t + e``; None without a camera matrix, without the contour stage, and
            where the contours do not fix the pose.
    """

    rotation: Tensor
    translation: Tensor | None
    score: float
    confidence: float
    ranking: Ranking
    candidates: Tensor
    view_rotation: Tensor
    view_distance: float
    iterations: int
    support: float | None = None
    covariance: Tensor | None = None

    @property
    def reliable(self) -> bool:
        """Whether the confidence is at least 0.6; False = no reliable match: take the pose as a guess."""
        return self.confidence >= RELIABLE

    @property
    def viewpoint(self) -> tuple[float, float, float]:
        """Azimuth, elevation, theta of ``rotation`` in degrees (PASCAL3D+)."""
        azimuth, elevation, theta = viewpoint_from_rotation(self.rotation)
        return float(azimuth), float(elevation), float(theta)

    @property
    def standard_deviations(self) -> tuple[Tensor, Tensor] | None:
        """(3,) degrees about and (3,) model units along the camera's axes; None without a covariance."""
        if self.covariance is None:
            return None
        deviations = self.covariance.diagonal().sqrt()
        return torch.rad2deg(deviations[:3]), deviations[3:]

    @property
    def transform(self) -> Tensor | None:
        """(4, 4) float64 ``T_cam_from_model``, None without a camera matrix."""
        if self.translation is None:
            return None
        T = torch.eye(4, dtype=torch.float64)
        T[:3, :3], T[:3, 3] = self.rotation, self.translation
        return T
