"""Candidate poses under work: the best distinct views of rankings, put into boxes, fitted and
judged."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..evidence import EvidenceWeights
from ..fitting.contour_problem import ContourProblem
from ..fitting.edges import EdgeCrops
from ..fitting.measured_fit import ContourFit
from ..fitting.texture_fit import fit_texture, rotated_starts
from ..fitting.together import fit_together, short_fit_together, support_together
from ..geometry.cameras import point_in_cameras, pose_from_box, projected_boxes, rotation_towards
from ..matching import Ranking, ViewBank, ViewDescriber, distinct_views
from ..pipeline import FitSettings
from ..utils.rows import Rows
from .confidence import are_near
from .result import Hypothesis

__all__ = [
    "Poses",
    "best_views",
    "close_rivals",
    "common_score",
    "distinct_poses",
    "fit_poses",
    "fit_texture_of",
    "hypothesis_of",
    "placed",
    "projected_box",
    "with_edge_support",
    "with_short_fit",
]


@dataclass(frozen=True)
class Poses(Rows):
    """H candidate poses of the object in a photograph.

    Attributes:
        crop_index: (H,) int64, in which of the boxes the pose is fitted.
        view: (H,) int64 view of the bank that the pose started from.
        rank: (H,) float64 log S of that view, minus that of the best view.
        rotation: (H, 3, 3) float64 allocentric rotations.
        distance: (H,) float64 of the object's centre, model units.
        T: (H, 4, 4) float64 ``T_cam_from_model``.
        cameras: (H, 3, 3) float64 in px of the photographs.
        covariance: (H, 6, 6) of a fit, NaN without one, see :func:`fit_contours`.
        edge_support, start_support: (H,) of a fit, NaN without one.
        observable: (H,) number of directions that a fit determines.
        short_fit: (H, 4, 4) the poses after a :func:`short_fit`, NaN without one; those of starts.
    """

    crop_index: Tensor
    view: Tensor
    rank: Tensor
    rotation: Tensor
    distance: Tensor
    T: Tensor
    cameras: Tensor
    covariance: Tensor
    edge_support: Tensor
    start_support: Tensor
    observable: Tensor
    short_fit: Tensor

    @staticmethod
    def at(T: Tensor, cameras: Tensor, centre: Tensor, view: Tensor, rank: Tensor) -> "Poses":
        """Poses ``T`` of an object with this centre (3,), which are not fitted, in the same box."""
        nan = torch.full((len(T),), torch.nan, dtype=torch.float64)
        none = torch.zeros_like(view)
        unknown = nan[:, None, None].repeat(1, 6, 6)
        short_fit = torch.full_like(T, torch.nan)
        return placed(
            Poses(
                none, view, rank, T[:, :3, :3], nan, T, cameras, unknown, nan, nan, none, short_fit
            ),
            T,
            centre,
        )

    @staticmethod
    def in_box(
        describer: ViewDescriber,
        box: Tensor,
        K: Tensor | None,
        rotation: Tensor,
        distance: Tensor,
        view: Tensor,
        rank: Tensor,
    ) -> "Poses":
        """Poses of allocentric rotations (H, 3, 3) that fill a box (4,).

        Without ``K`` (3, 3), cameras look straight at the box from ``distance`` (H,).
        """
        boxes = box.double().expand(len(view), 4)
        if K is None:
            T, cameras = describer.cameras_of_boxes(rotation, distance, boxes)
            poses = Poses.at(T, cameras, describer.centre, view, rank)
            return replace(poses, rotation=rotation, distance=distance)
        cameras = K.double().expand(len(view), 3, 3)
        T = torch.eye(4, dtype=torch.float64).repeat(len(view), 1, 1)
        T[:, :3, :3], T[:, :3, 3] = pose_from_box(describer.hull, rotation, boxes, cameras)
        return Poses.at(T, cameras, describer.centre, view, rank)

    @property
    def fit(self) -> ContourFit:
        """The poses as a fit."""
        return ContourFit(
            self.T, self.covariance, self.edge_support, self.start_support, self.observable
        )

    def with_fit(self, fit: ContourFit, centre: Tensor) -> "Poses":
        """Return the poses of a fit, for an object with this centre (3,)."""
        measured = fit.columns()
        T = measured.pop("transform")
        return placed(replace(self, **measured), T, centre)


def placed(poses: Poses, T: Tensor, centre: Tensor) -> Poses:
    """Return the poses at ``T`` (H, 4, 4), with allocentric rotations and distances to match."""
    position = point_in_cameras(T, centre)
    rotation = rotation_towards(position).mT @ T[:, :3, :3]
    return replace(
        poses, T=T, rotation=rotation, distance=torch.linalg.vector_norm(position, dim=1)
    )


def best_views(
    ranking: Ranking, bank: ViewBank, *, count: int, symmetries: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """At most ``count`` best distinct allowed views of the ranking of a photograph, and their
    ranks, each (H,)."""
    order = ranking.order[0]
    if ranking.allowed is not None:
        order = order[ranking.allowed[0][order]]
    rotations = bank.views.rotations  # on the CPU, in the precision of bank.rotations
    view = distinct_views(order, rotations, count=count, symmetries=symmetries).cpu()
    log = ranking.scores[0].cpu().double().clamp(min=torch.finfo(torch.float64).tiny).log()
    return view, log[view] - log.max()


def fit_poses(
    describer: ViewDescriber,
    crops: EdgeCrops,
    poses: Poses,
    *,
    settings: FitSettings = FitSettings(),
    **options: Any,
) -> Poses:
    """Fit the contours of poses to crops, see :func:`fit_to_edges` and its ``options``."""
    given = describer.device_contours, crops, poses.cameras, poses.T, poses.crop_index
    finish = options.pop("finish", settings.finished_fits)
    fit = fit_together(*given, settings=settings, finish=finish, **options)
    return poses.with_fit(fit, describer.centre)


def with_short_fit(
    describer: ViewDescriber, crops: EdgeCrops, poses: Poses
) -> tuple[Poses, Tensor]:
    """Return the poses with their short fits, and the edge supports (H,) that these reach, see
    :func:`short_fit`."""
    given = describer.device_contours, crops, poses.cameras, poses.T, poses.crop_index
    T, support = short_fit_together(*given)
    return replace(poses, short_fit=T), support


def fit_texture_of(
    describer: ViewDescriber, crops: EdgeCrops, poses: Poses, h: int
) -> Poses | None:
    """Pose ``h``, fitted to the colours of its mesh too, see :func:`fit_texture`; None without
    colours or fit."""
    if not describer.draws_colours:
        return None
    one = poses[torch.tensor([h])]
    problem = ContourProblem.of(describer.contours, crops, one.cameras, one.crop_index)
    photograph = crops.crops[int(one.crop_index)]
    starts = rotated_starts(one.fit, describer.centre)
    fit = fit_texture(
        describer.draw, describer.renderer, replace(problem, mask=None), photograph, starts
    )
    return None if fit is None else one.with_fit(fit, describer.centre)


def with_edge_support(describer: ViewDescriber, crops: EdgeCrops, poses: Poses) -> Poses:
    """Poses that are not fitted, with their edge support, see :func:`contour_support`."""
    given = describer.device_contours, crops, poses.cameras, poses.T, poses.crop_index
    support = support_together(*given)
    return replace(poses, edge_support=support)


def common_score(hypothesis: Hypothesis, weights: EvidenceWeights) -> float:
    """The part of the score that results in different boxes have in common: similarity and
    keypoints, weighted."""
    evidence = hypothesis.evidence
    similarity = weights.similarity * evidence["similarity"]
    return similarity + weights.keypoints * evidence["keypoints"]


def distinct_poses(
    poses: Poses, score: Tensor, symmetries: Tensor | None = None, *, angle: float
) -> Tensor:
    """(H,) bool: False where a pose is within ``angle`` degrees of one with a higher ``score``
    (H,)."""
    order = score.argsort(descending=True, stable=True)
    R = poses.rotation[order].float()
    best_first = torch.arange(len(order))
    chosen = distinct_views(best_first, R, count=len(order), angle=angle, symmetries=symmetries)
    return torch.zeros(len(order), dtype=torch.bool).index_fill(0, order[chosen], True)


def close_rivals(
    poses: Poses, scores: Tensor, symmetries: Tensor | None = None, *, behind: float
) -> Tensor:
    """(R,) indices of other poses whose scores (H,) are less than ``behind`` below the best one,
    best first."""
    best = int(scores.argmax())
    same = are_near(poses.rotation, poses.rotation[best], symmetries)
    close = ~same & (scores > scores[best] - behind)
    order = torch.where(close, scores, -torch.inf).argsort(descending=True, stable=True)
    return order[: int(close.sum())]


def projected_box(describer: ViewDescriber, projection: tuple[Tensor, Tensor]) -> Tensor:
    """(4,) float64 box around the projected mesh, px of the photograph."""
    T, K = projection
    return projected_boxes(describer.hull, T[None], K)[0]


def hypothesis_of(
    poses: Poses,
    h: int,
    evidence: Mapping[str, float],
    *,
    score: str = "similarity",
    with_camera: bool = True,
) -> Hypothesis:
    """Pose ``h`` with its ``evidence``, one of which is its ``score``, as it is reported."""
    T = poses.T[h]
    support = float(poses.edge_support[h])
    covariance = poses.covariance[h]
    return Hypothesis(
        rotation=T[:3, :3].clone() if with_camera else poses.rotation[h].clone(),
        translation=T[:3, 3].clone() if with_camera else None,
        score=evidence[score],
        evidence=evidence,
        allocentric_rotation=poses.rotation[h].clone(),
        distance=float(poses.distance[h]),
        projection=(T.clone(), poses.cameras[h].clone()),
        view=int(poses.view[h]),
        edge_support=None if math.isnan(support) else support,
        covariance=covariance.clone()
        if with_camera and bool(covariance.isfinite().all())
        else None,
    )
