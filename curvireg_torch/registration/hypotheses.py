"""Hypotheses: one table of the poses of many photographs, with what speaks for each; and how it is
filled from views, fits and boxes."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..evidence import Evidence, EvidenceWeights
from ..fitting.contour_fit import fit_to_edges, short_fit
from ..fitting.contour_problem import ContourProblem
from ..fitting.devices import on_device
from ..fitting.edges import EdgeCrops
from ..fitting.measured_fit import ContourFit, edges_at
from ..fitting.texture_fit import fit_texture, rotated_starts
from ..geometry.cameras import boxes_of, point_in_cameras, pose_from_box, rotation_towards
from ..matching import Ranking, ViewBank, ViewDescriber, distinct_views
from ..pipeline import FitSettings
from ..utils.rows import Rows
from ..utils.segments import best_within
from .confidence import are_near
from .result import Hypothesis

__all__ = [
    "Hypotheses",
    "are_repeated",
    "best_views",
    "by_contours",
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

Measured = TypeVar("Measured")


@dataclass(frozen=True)
class Hypotheses(Rows):
    """N poses of an object in P photographs.

    Attributes:
        photograph: (N,) int64, in which of the photographs, and of their boxes, the pose is fitted.
        view: (N,) int64 view of the bank that the pose started from.
        rank: (N,) float64 log S of that view, minus that of the best view.
        rotation: (N, 3, 3) float64 allocentric rotations.
        distance: (N,) float64 of the object's centre, model units.
        T: (N, 4, 4) float64 ``T_cam_from_model``.
        cameras: (N, 3, 3) float64 in px of the photographs.
        covariance: (N, 6, 6) of a fit, NaN without one, see :func:`fit_contours`.
        edge_support, start_support: (N,) of a fit, NaN without one.
        observable: (N,) number of directions that a fit determines.
        edge_excess: (N,) see :class:`.ContourFit`; NaN until it is measured at the pose.
        short_fit: (N, 4, 4) the poses after a :func:`short_fit`, NaN without one; those of starts.
        evidence: of them, 0 until it is measured.
        is_outside: (N,) bool, those that lie outside the limits of their photograph, one of each at
            most: they are never reported, and tell whether the limits are wrong.
        is_repeated: (N,) bool, those that repeat another one of the photograph: the same view with
            another camera, or a pose that keypoints agree on, in place of the views near it.
        is_distinct: (N,) bool, False of poses that merged with a better one.
        is_sibling: (N,) bool, those that a symmetry of the shape makes of the best one, which a
            feature of the mesh tells apart.
    """

    photograph: Tensor
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
    edge_excess: Tensor
    short_fit: Tensor
    evidence: Evidence
    is_outside: Tensor
    is_repeated: Tensor
    is_distinct: Tensor
    is_sibling: Tensor

    @staticmethod
    def at(
        T: Tensor,
        cameras: Tensor,
        centre: Tensor,
        view: Tensor,
        rank: Tensor,
        photograph: Tensor | None = None,
    ) -> "Hypotheses":
        """Poses ``T`` of an object with this centre (3,), which are not fitted, by default in the
        first photograph."""
        count = len(T)
        nan = torch.full((count,), torch.nan, dtype=torch.float64)
        none = torch.zeros(count, dtype=torch.bool)
        poses = Hypotheses(
            photograph=torch.zeros_like(view) if photograph is None else photograph,
            view=view,
            rank=rank,
            rotation=T[:, :3, :3],
            distance=nan,
            T=T,
            cameras=cameras,
            covariance=nan[:, None, None].repeat(1, 6, 6),
            edge_support=nan,
            start_support=nan,
            observable=torch.zeros_like(view),
            edge_excess=nan,
            short_fit=torch.full_like(T, torch.nan),
            evidence=Evidence.zeros(count),
            is_outside=none,
            is_repeated=none,
            is_distinct=~none,
            is_sibling=none,
        )
        return placed(poses, T, centre)

    @staticmethod
    def in_boxes(
        describer: ViewDescriber,
        boxes: Tensor,
        cameras: Tensor,
        rotation: Tensor,
        distance: Tensor,
        view: Tensor,
        rank: Tensor,
        photograph: Tensor | None = None,
    ) -> "Hypotheses":
        """Poses of allocentric rotations (N, 3, 3) that fill boxes (N, 4) of photographs by
        ``cameras`` (N, 3, 3). Where these are NaN, cameras look straight at the box from
        ``distance`` (N,)."""
        boxes = boxes.double()
        unknown = cameras[:, 0, 0].isnan()
        T = torch.eye(4, dtype=torch.float64).repeat(len(view), 1, 1)
        if not bool(unknown.all()):
            known = (~unknown).nonzero()[:, 0]
            filling = pose_from_box(describer.hull, rotation[known], boxes[known], cameras[known])
            T[known, :3, :3], T[known, :3, 3] = filling
        if not bool(unknown.any()):
            return Hypotheses.at(T, cameras, describer.centre, view, rank, photograph)
        some = unknown.nonzero()[:, 0]
        straight, K = describer.cameras_of_boxes(rotation[some], distance[some], boxes[some])
        T = T.index_copy(0, some, straight)
        cameras = cameras.index_copy(0, some, K)
        poses = Hypotheses.at(T, cameras, describer.centre, view, rank, photograph)
        return replace(
            poses,
            rotation=torch.where(unknown[:, None, None], rotation, poses.rotation),
            distance=torch.where(unknown, distance, poses.distance),
        )

    @property
    def fit(self) -> ContourFit:
        """The poses as a fit."""
        return ContourFit(
            self.T,
            self.covariance,
            self.edge_support,
            self.start_support,
            self.observable,
            self.edge_excess,
        )

    def with_fit(self, fit: ContourFit, centre: Tensor) -> "Hypotheses":
        """Return the poses of a fit, for an object with this centre (3,)."""
        measured = fit.columns()
        T = measured.pop("transform")
        return replace(placed(self, T, centre), **measured)

    def with_poses(self, index: Tensor, others: "Hypotheses") -> "Hypotheses":
        """Put the poses of ``others``, with their evidence, in the places ``index`` (M,); what is
        known of these places beside it stays."""
        here = self[index]
        flags = {name: column for name, column in here.columns().items() if name.startswith("is_")}
        return self.replaced(index, replace(others, **flags))

    def scores(self, weights: EvidenceWeights) -> Tensor:
        """(N,) weighted sums of the evidence, -inf for poses outside the limits and merged ones."""
        excluded = self.is_outside | ~self.is_distinct
        return self.evidence.scores(weights).masked_fill(excluded, -torch.inf)

    def best(self, weights: EvidenceWeights) -> Tensor:
        """(P,) row with the highest of the :meth:`scores` of each photograph."""
        return best_within(self.scores(weights), self.photograph)

    def of(self, photograph: int) -> Tensor:
        """(M,) the rows of a photograph."""
        return (self.photograph == photograph).nonzero()[:, 0]


def placed(poses: Hypotheses, T: Tensor, centre: Tensor) -> Hypotheses:
    """Return the poses at ``T`` (H, 4, 4), with allocentric rotations and distances to match, where
    no edges are measured."""
    position = point_in_cameras(T, centre)
    rotation = rotation_towards(position).mT @ T[:, :3, :3]
    return replace(
        poses,
        T=T,
        rotation=rotation,
        distance=torch.linalg.vector_norm(position, dim=1),
        edge_excess=torch.full_like(poses.edge_excess, torch.nan),
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


def by_contours(
    function: Callable[..., Measured],
    describer: ViewDescriber,
    crops: EdgeCrops,
    poses: Hypotheses,
    **options: Any,
) -> Measured:
    """``function`` of the mesh's contours, of crops, and of the cameras, poses and photographs of
    hypotheses, see :func:`.on_device`."""
    given = poses.cameras, poses.T, poses.photograph
    return on_device(function, describer.device_contours, crops, *given, **options)


def fit_poses(
    describer: ViewDescriber,
    crops: EdgeCrops,
    poses: Hypotheses,
    *,
    settings: FitSettings = FitSettings(),
    **options: Any,
) -> Hypotheses:
    """Fit the contours of poses to crops, see :func:`fit_to_edges` and its ``options``."""
    finish = options.pop("finish", settings.finished_fits)
    options |= {"settings": settings, "finish": finish}
    fit = by_contours(fit_to_edges, describer, crops, poses, **options)
    return poses.with_fit(fit, describer.centre)


def with_short_fit(
    describer: ViewDescriber, crops: EdgeCrops, poses: Hypotheses
) -> tuple[Hypotheses, Tensor]:
    """Return the poses with their short fits, and the edge supports (H,) that these reach, see
    :func:`short_fit`."""
    T, support = by_contours(short_fit, describer, crops, poses)
    return replace(poses, short_fit=T), support


def fit_texture_of(
    describer: ViewDescriber, crops: EdgeCrops, one: Hypotheses
) -> Hypotheses | None:
    """One pose, fitted to the colours of its mesh too, see :func:`fit_texture`; None without
    colours or fit."""
    if not describer.draws_colours:
        return None
    problem = ContourProblem.of(describer.contours, crops, one.cameras, one.photograph)
    photograph = crops.crops[int(one.photograph)]
    starts = rotated_starts(one.fit, describer.centre)
    fit = fit_texture(
        describer.draw, describer.renderer, replace(problem, mask=None), photograph, starts
    )
    return None if fit is None else one.with_fit(fit, describer.centre)


def with_edge_support(describer: ViewDescriber, crops: EdgeCrops, poses: Hypotheses) -> Hypotheses:
    """Poses that are not fitted, with their edges, see :func:`edges_at`."""
    support, excess = by_contours(edges_at, describer, crops, poses)
    return replace(poses, edge_support=support, edge_excess=excess)


def common_score(hypothesis: Hypothesis, weights: EvidenceWeights) -> float:
    """The part of the score that results in different boxes have in common: similarity and
    keypoints, weighted."""
    evidence = hypothesis.evidence
    similarity = weights.similarity * evidence["similarity"]
    return similarity + weights.keypoints * evidence["keypoints"]


def are_repeated(views: Tensor, photograph: Tensor) -> Tensor:
    """(N,) bool: whether a view (N,) is among those before it of the same ``photograph`` (N,)."""
    equal = (views == views[:, None]) & (photograph == photograph[:, None])
    return equal.tril(diagonal=-1).any(dim=1)


def distinct_poses(
    rotations: Tensor, score: Tensor, symmetries: Tensor | None = None, *, angle: float
) -> Tensor:
    """(H,) bool: False where the rotation of a pose, of (H, 3, 3), is within ``angle`` degrees of
    one with a higher ``score`` (H,)."""
    order = score.argsort(descending=True, stable=True)
    R = rotations[order].float()
    best_first = torch.arange(len(order))
    chosen = distinct_views(best_first, R, count=len(order), angle=angle, symmetries=symmetries)
    return torch.zeros(len(order), dtype=torch.bool).index_fill(0, order[chosen], True)


def close_rivals(
    rotations: Tensor, scores: Tensor, symmetries: Tensor | None = None, *, behind: float
) -> Tensor:
    """(R,) indices of poses with other ``rotations`` than the best one, of (H, 3, 3), whose scores
    (H,) are less than ``behind`` below its, best first."""
    best = int(scores.argmax())
    same = are_near(rotations, rotations[best], symmetries)
    close = ~same & (scores > scores[best] - behind)
    order = torch.where(close, scores, -torch.inf).argsort(descending=True, stable=True)
    return order[: int(close.sum())]


def projected_box(describer: ViewDescriber, projection: tuple[Tensor, Tensor]) -> Tensor:
    """(4,) float64 box around the projected mesh, px of the photograph."""
    T, K = projection
    return boxes_of(describer.hull, T, K)


def hypothesis_of(
    poses: Hypotheses,
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
