"""Hypotheses as poses before cameras, and back: of several models, each by its own describer."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from ..geometry.cameras import rotation_towards
from ..geometry.translation import pose_from_box
from ..matching import ViewDescriber
from .contour import ContourFit, contour_support, fit_contours
from .hypotheses import Hypotheses
from .search import FINALISTS

__all__ = ["Poses", "follow_contours", "lift_to_poses", "supports", "to_allocentric"]


@dataclass(frozen=True)
class Poses:
    """H hypotheses before their photographs.

    Attributes:
        found: the hypotheses.
        T: (H, 4, 4) ``T_cam_from_model``.
        cameras: (H, 3, 3) in px of the photographs.
        fit: what the contour stage made of them, or None.
    """

    found: Hypotheses
    T: Tensor
    cameras: Tensor
    fit: ContourFit | None = None

    def where(self, kept: Tensor, others: "Poses") -> "Poses":
        """Select per hypothesis: these poses where ``kept`` (H,) is True, else ``others``.

        Scores are those of ``self``. The covariance is NaN where the pose is taken from ``others``.
        """
        pose = kept[:, None, None]
        T = torch.where(pose, self.T, others.T)
        found = replace(
            self.found,
            rotation=torch.where(pose, self.found.rotation, others.found.rotation),
            distance=torch.where(kept, self.found.distance, others.found.distance),
        )
        fit = self.fit
        if fit is not None:
            fit = replace(fit, transform=T, covariance=torch.where(pose, fit.covariance, torch.nan))
        return Poses(found, T, torch.where(pose, self.cameras, others.cameras), fit)

    def __getitem__(self, index: Tensor) -> "Poses":
        """Some of the poses, without their fit."""
        return Poses(self.found[index], self.T[index], self.cameras[index])


def lift_to_poses(describers: Sequence[ViewDescriber], found: Hypotheses, boxes: Tensor, K: Tensor | None) -> Poses:
    """Hypotheses as poses that fill their boxes.

    Args:
        describers: of the bank's models.
        boxes: (B, 4) of the photographs, px.
        K: (B, 3, 3) of the photographs; None: unknown, a camera that looks straight at the box is assumed.
    """
    T = torch.eye(4, dtype=torch.float64).repeat(len(found), 1, 1)
    cameras = torch.eye(3, dtype=torch.float64).repeat(len(found), 1, 1)
    for model, mine in _by_model(found):
        describe, photograph = describers[model], found.photograph[mine]
        if K is None:
            T[mine], cameras[mine] = describe.cameras_of_boxes(
                found.rotation[mine], found.distance[mine], boxes[photograph]
            )
        else:
            cameras[mine] = K[photograph]
            T[mine, :3, :3], T[mine, :3, 3] = pose_from_box(
                describe.hull, found.rotation[mine], boxes[photograph], K[photograph]
            )
    return Poses(found, T, cameras)


def to_allocentric(describers: Sequence[ViewDescriber], found: Hypotheses, T: Tensor) -> Hypotheses:
    """The hypotheses with the allocentric rotations and distances of poses (H, 4, 4)."""
    rotation, distance = found.rotation.clone(), found.distance.clone()
    for model, mine in _by_model(found):
        R, t = T[mine, :3, :3], T[mine, :3, 3]
        position = R @ describers[model].centre + t
        rotation[mine] = rotation_towards(position).mT @ R
        distance[mine] = torch.linalg.vector_norm(position, dim=1)
    return replace(found, rotation=rotation, distance=distance)


def follow_contours(
    describers: Sequence[ViewDescriber], images: Sequence[Tensor], poses: Poses, boxes: Tensor
) -> Poses:
    """What :func:`fit_contours` makes of poses of all models."""
    parts, index = [], []
    for model, mine in _by_model(poses.found):
        where, shape = _before_photographs(describers[model], images, poses, boxes, mine)
        parts.append(fit_contours(*where, **shape, finish=FINALISTS))
        index.append(mine)
    place = torch.cat(index).argsort()
    fit = ContourFit(*(torch.cat([getattr(part, f.name) for part in parts])[place] for f in fields(ContourFit)))
    return Poses(to_allocentric(describers, poses.found, fit.transform), fit.transform, poses.cameras, fit)


def supports(describers: Sequence[ViewDescriber], images: Sequence[Tensor], poses: Poses, boxes: Tensor) -> Tensor:
    """(H,) contour support of poses of all models as they are, see :func:`contour_support`."""
    out = torch.zeros(len(poses.found), dtype=torch.float64)
    for model, mine in _by_model(poses.found):
        where, shape = _before_photographs(describers[model], images, poses, boxes, mine)
        out[mine] = contour_support(*where, **shape)
    return out


def _before_photographs(
    describe: ViewDescriber, images: Sequence[Tensor], poses: Poses, boxes: Tensor, mine: Tensor
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Arguments of the contour stage for the poses ``mine``, all of one model."""
    where = describe.renderer, images, boxes, poses.cameras[mine], poses.T[mine]
    return where, {
        "photograph": poses.found.photograph[mine],
        "centre": describe.centre,
        "radius": describe.radius,
        "margin": describe.settings.margin,
    }


def _by_model(found: Hypotheses) -> list[tuple[int, Tensor]]:
    return [(m, (found.model == m).nonzero()[:, 0]) for m in found.model.unique().tolist()]
