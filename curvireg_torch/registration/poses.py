"""Hypotheses lifted to poses in front of cameras, and back; each model has its own describer."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from ..geometry.cameras import rotation_towards
from ..geometry.translation import pose_from_box
from ..matching import ViewDescriber
from .contour_fit import ContourFit, contour_support, fit_contours
from .hypotheses import Hypotheses
from .rescoring import POSE_FEATURES
from .results import Hypothesis
from .search import FINALISTS
from .texture_fit import fit_texture, turned

__all__ = ["Poses", "edge_supports", "fit_poses", "fit_texture_of", "hypothesis_of", "lift_to_poses"]


@dataclass(frozen=True)
class Poses:
    """H hypotheses as poses ``T`` (H, 4, 4) ``T_cam_from_model`` in front of ``cameras`` (H, 3, 3) px, after a fit."""

    hypotheses: Hypotheses
    T: Tensor
    cameras: Tensor
    fit: ContourFit | None = None

    def where(self, keep: Tensor, others: "Poses") -> "Poses":
        """These poses where ``keep`` (H,) is True, else ``others``, whose covariance is NaN."""
        pose = keep[:, None, None]
        T = torch.where(pose, self.T, others.T)
        hypotheses = replace(
            self.hypotheses,
            rotation=torch.where(pose, self.hypotheses.rotation, others.hypotheses.rotation),
            distance=torch.where(keep, self.hypotheses.distance, others.hypotheses.distance),
        )
        fit = self.fit
        if fit is not None:
            fit = replace(fit, transform=T, covariance=torch.where(pose, fit.covariance, torch.nan))
        return Poses(hypotheses, T, torch.where(pose, self.cameras, others.cameras), fit)

    def __getitem__(self, index: Tensor) -> "Poses":
        """The poses without their fit."""
        return Poses(self.hypotheses[index], self.T[index], self.cameras[index])


def lift_to_poses(
    describers: Sequence[ViewDescriber], hypotheses: Hypotheses, boxes: Tensor, K: Tensor | None
) -> Poses:
    """Hypotheses as poses that fill (B, 4) boxes; without ``K`` (B, 3, 3) cameras look straight at the boxes."""
    T = torch.eye(4, dtype=torch.float64).repeat(len(hypotheses), 1, 1)
    cameras = torch.eye(3, dtype=torch.float64).repeat(len(hypotheses), 1, 1)
    for model, mine in hypotheses.by_model():
        describer, image = describers[model], hypotheses.image_index[mine]
        rotation, distance = hypotheses.rotation[mine], hypotheses.distance[mine]
        if K is None:
            T[mine], cameras[mine] = describer.cameras_of_boxes(rotation, distance, boxes[image])
        else:
            cameras[mine] = K[image]
            T[mine, :3, :3], T[mine, :3, 3] = pose_from_box(describer.hull, rotation, boxes[image], K[image])
    return Poses(hypotheses, T, cameras)


def to_allocentric(describers: Sequence[ViewDescriber], hypotheses: Hypotheses, T: Tensor) -> Hypotheses:
    """The hypotheses with the allocentric rotations and distances of poses (H, 4, 4)."""
    rotation, distance = hypotheses.rotation.clone(), hypotheses.distance.clone()
    for model, mine in hypotheses.by_model():
        R, t = T[mine, :3, :3], T[mine, :3, 3]
        position = R @ describers[model].centre + t
        rotation[mine] = rotation_towards(position).mT @ R
        distance[mine] = torch.linalg.vector_norm(position, dim=1)
    return replace(hypotheses, rotation=rotation, distance=distance)


def fit_poses(
    describers: Sequence[ViewDescriber],
    images: Sequence[Tensor],
    poses: Poses,
    boxes: Tensor,
    object_mask: Tensor | None = None,
) -> Poses:
    """Fit the contours of poses of all models, see :func:`fit_contours`."""
    parts, index = [], []
    for model, mine in poses.hypotheses.by_model():
        args, options = _contour_arguments(describers[model], images, poses, boxes, mine)
        parts.append(fit_contours(*args, **options, finish=FINALISTS, object_mask=object_mask))
        index.append(mine)
    back = torch.cat(index).argsort()
    fit = ContourFit(*(torch.cat([getattr(part, f.name) for part in parts])[back] for f in fields(ContourFit)))
    return Poses(to_allocentric(describers, poses.hypotheses, fit.transform), fit.transform, poses.cameras, fit)


def fit_texture_of(
    describers: Sequence[ViewDescriber], images: Sequence[Tensor], poses: Poses, boxes: Tensor, h: int
) -> Poses | None:
    """The poses with pose ``h`` fitted to the colours of its mesh too, see :func:`fit_texture`; None without a fit."""
    assert poses.fit is not None
    describer, b = describers[int(poses.hypotheses.model[h])], int(poses.hypotheses.image_index[h])
    if not describer.draws_colours:
        return None
    one = torch.tensor([h])
    args, options = _contour_arguments(describer, [images[b]], poses, boxes[b : b + 1], one)
    options |= {"image_index": torch.zeros_like(one), "starts": turned(poses.fit[one], describer.centre)}
    fit = fit_texture(describer.draw, describer.renderer, *args[:4], **options)
    if fit is None:
        return None
    parts = (getattr(poses.fit, f.name).index_copy(0, one, getattr(fit, f.name)) for f in fields(ContourFit))
    fits = ContourFit(*parts)
    return Poses(to_allocentric(describers, poses.hypotheses, fits.transform), fits.transform, poses.cameras, fits)


def edge_supports(describers: Sequence[ViewDescriber], images: Sequence[Tensor], poses: Poses, boxes: Tensor) -> Tensor:
    """(H,) edge support of poses of all models that are not fitted, see :func:`contour_support`."""
    out = torch.zeros(len(poses.hypotheses), dtype=torch.float64)
    for model, mine in poses.hypotheses.by_model():
        args, options = _contour_arguments(describers[model], images, poses, boxes, mine)
        out[mine] = contour_support(*args, **options)
    return out


def hypothesis_of(h: int, poses: Poses, evidence: Tensor, *, with_camera: bool) -> Hypothesis:
    """Hypothesis ``h`` of poses with their (H, 4) :data:`POSE_FEATURES`, as it is reported."""
    hypotheses, T, fit = poses.hypotheses, poses.T[h], poses.fit
    features = dict(zip(POSE_FEATURES, evidence[h].tolist(), strict=True))
    known = fit is not None and with_camera and bool(fit.covariance[h].isfinite().all())
    return Hypothesis(
        rotation=T[:3, :3].clone() if with_camera else hypotheses.rotation[h].clone(),
        translation=T[:3, 3].clone() if with_camera else None,
        score=features["similarity"],
        evidence=features,
        allocentric_rotation=hypotheses.rotation[h].clone(),
        distance=float(hypotheses.distance[h]),
        projection=(T.clone(), poses.cameras[h].clone()),
        view=int(hypotheses.view[h]),
        model=int(hypotheses.model[h]),
        edge_support=None if fit is None else features["edge_support"],
        covariance=fit.covariance[h].clone() if fit is not None and known else None,
    )


def _contour_arguments(
    describer: ViewDescriber, images: Sequence[Tensor], poses: Poses, boxes: Tensor, mine: Tensor
) -> tuple[list[Any], dict[str, Any]]:
    """Arguments of the contour functions for the poses ``mine``, all of one model."""
    return [describer.contours, images, boxes, poses.cameras[mine], poses.T[mine]], {
        "image_index": poses.hypotheses.image_index[mine],
        "margin": describer.settings.margin,
    }
