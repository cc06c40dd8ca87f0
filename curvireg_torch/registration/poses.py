"""Candidate poses under work: the best distinct views of rankings, put into boxes, fitted and
judged."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..fitting.contour_problem import ContourProblem
from ..fitting.edges import EdgeCrops
from ..fitting.measured_fit import ContourFit
from ..fitting.texture_fit import fit_texture, turned
from ..fitting.together import (
    details_together,
    fit_together,
    quick_fit_together,
    support_together,
)
from ..geometry.cameras import pose_from_box, projected_boxes, rotation_towards
from ..matching import Ranking, ViewBank, ViewDescriber, distinct_views
from ..terms import Appearance, QueryFeatures
from ..utils.company import by_key, compute_together
from .confidence import are_near
from .result import Hypothesis
from .target import Target

__all__ = [
    "POSE_FEATURES",
    "SCORE_WEIGHTS",
    "SCREENING_WEIGHT",
    "Poses",
    "best_views",
    "close_rivals",
    "common_score",
    "compare_with_photograph",
    "distinct_poses",
    "fit_poses",
    "fit_texture_of",
    "hypothesis_of",
    "landmark_evidence",
    "named_features",
    "placed",
    "pose_features",
    "pose_scores",
    "projected_box",
    "similarities",
    "with_details",
    "with_edge_support",
    "with_quick_fit",
]

SAME_POSE_ANGLE = 15.0
"""Degrees within which two fitted hypotheses count as one."""

SCREENING_WEIGHT = 20.0
"""Weight of the edge support that a short fit reaches, beside log S, in the choice of the views
that are fitted."""

FINISHED_FITS = 2
"""Hypotheses of a photograph whose contours are fitted at full size."""

CLOSE_SCORE = 2.5
CLOSE_RIVALS = 2
"""Score by which rivals may be behind to be compared with the best pose in detail, and how many of
them are fitted as thoroughly."""

POSE_FEATURES = ("rank", "similarity", "edge_support", "appearance", "landmarks", "details")
"""Features of a pose: log S of the view it started from, minus that of the best view; normalised
correlation of the pose's view with the photograph; edge support (0 without the contour fit); log
appearance score of the pose (0 without that term); log (1 + n) with the number n of landmarks that
agree with it, beyond ``CHANCE_LANDMARKS`` (0 without colours, camera or contour fit, with a similar
mesh, and where a given pose is refined); by how much the contours that only this pose or only the
best one predicts speak for it, see :func:`.compare_details` (0 for poses that score far less than
the best)."""

CHANCE_LANDMARKS = 2
"""Landmarks that agree with a wrong pose by chance: on generated shelves, 96 % of wrong hypotheses
have no more."""

SCORE_WEIGHTS = (0.0, 10.0, 10.0, 2.5, 6.0, 1.0)
RANK_ALONE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Weights of the features in the score of a pose, with an exact mesh and with a similar one
(docs/experiments.md). The rank does not count where poses are fitted: how near a view of the bank
was to one is a matter of sampling."""


@dataclass(frozen=True)
class Poses:
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
        quick: (H, 4, 4) the poses after a :func:`quick_fit`, NaN without one; those of starts.
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
    quick: Tensor

    @staticmethod
    def at(T: Tensor, cameras: Tensor, centre: Tensor, view: Tensor, rank: Tensor) -> "Poses":
        """Poses ``T`` of an object with this centre (3,), which are not fitted, in the same box."""
        nan = torch.full((len(T),), torch.nan, dtype=torch.float64)
        none = torch.zeros_like(view)
        unknown = nan[:, None, None].repeat(1, 6, 6)
        quick = torch.full_like(T, torch.nan)
        return placed(
            Poses(none, view, rank, T[:, :3, :3], nan, T, cameras, unknown, nan, nan, none, quick),
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

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, index: Tensor) -> "Poses":
        return Poses(*(getattr(self, f.name)[index] for f in fields(Poses)))

    @staticmethod
    def cat(parts: "Sequence[Poses]") -> "Poses":
        """Return all poses."""
        return Poses(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Poses)))

    def replaced(self, index: Tensor, others: "Poses") -> "Poses":
        """Return these poses with ``others`` in the places ``index``."""
        return Poses(
            *(
                getattr(self, f.name).index_copy(0, index, getattr(others, f.name))
                for f in fields(Poses)
            )
        )

    @property
    def fit(self) -> ContourFit:
        """The poses as a fit."""
        return ContourFit(
            self.T, self.covariance, self.edge_support, self.start_support, self.observable
        )

    def with_fit(self, fit: ContourFit, centre: Tensor) -> "Poses":
        """Return the poses of a fit, for an object with this centre (3,)."""
        measured = {
            f.name: getattr(fit, f.name) for f in fields(ContourFit) if f.name != "transform"
        }
        return placed(replace(self, **measured), fit.transform, centre)


def placed(poses: Poses, T: Tensor, centre: Tensor) -> Poses:
    """Return the poses at ``T`` (H, 4, 4), with allocentric rotations and distances to match."""
    position = T[:, :3, :3] @ centre + T[:, :3, 3]
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


def fit_poses(describer: ViewDescriber, crops: EdgeCrops, poses: Poses, **options: Any) -> Poses:
    """Fit the contours of poses to crops, see :func:`fit_to_edges` and its ``options``."""
    given = describer.device_contours, crops, poses.cameras, poses.T, poses.crop_index
    return poses.with_fit(
        fit_together(*given, **{"finish": FINISHED_FITS, **options}), describer.centre
    )


def with_quick_fit(
    describer: ViewDescriber, crops: EdgeCrops, poses: Poses
) -> tuple[Poses, Tensor]:
    """Return the poses with their short fits, and the edge supports (H,) that these reach, see
    :func:`quick_fit`."""
    given = describer.device_contours, crops, poses.cameras, poses.T, poses.crop_index
    T, support = quick_fit_together(*given)
    return replace(poses, quick=T), support


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
    starts = turned(one.fit, describer.centre)
    fit = fit_texture(
        describer.draw, describer.renderer, replace(problem, mask=None), photograph, starts
    )
    return None if fit is None else one.with_fit(fit, describer.centre)


def with_edge_support(describer: ViewDescriber, crops: EdgeCrops, poses: Poses) -> Poses:
    """Poses that are not fitted, with their edge support, see :func:`contour_support`."""
    given = describer.device_contours, crops, poses.cameras, poses.T, poses.crop_index
    support = support_together(*given)
    return replace(poses, edge_support=support)


def similarities(views: Tensor, descriptors: Tensor) -> Tensor:
    """(H,) normalised correlations of descriptors (H, D) of views with those (H, D) or (1, D) of
    photographs."""
    return (F.normalize(views, dim=1) * F.normalize(descriptors, dim=1)).sum(dim=1).double().cpu()


def compare_with_photograph(
    target: Target,
    query: QueryFeatures,
    descriptor: Tensor,
    ranking: Ranking,
    rotation: Tensor,
    distance: Tensor,
) -> tuple[Tensor, Tensor]:
    """Similarities (H,) of poses, allocentric rotations (H, 3, 3) and distances (H,), with a
    photograph that is described as ``query`` and, on a grid twice as fine as the bank's, by
    ``descriptor`` (1, D); and their appearance scores (H,), 0 where its ``ranking`` lacks that
    term."""
    request = _Comparison(target, query, descriptor, ranking, rotation, distance)
    return compute_together(_compared, request)


@dataclass(frozen=True)
class _Comparison:
    """The arguments of :func:`compare_with_photograph`."""

    target: Target
    query: QueryFeatures
    descriptor: Tensor
    ranking: Ranking
    rotation: Tensor
    distance: Tensor

    @property
    def key(self) -> tuple[Any, ...]:
        return id(self.target.describer), Appearance.name in self.ranking.terms


def _compared(requests: Sequence[_Comparison]) -> list[tuple[Tensor, Tensor]]:
    return by_key(requests, lambda request: request.key, _compared_with_one_mesh)


def _compared_with_one_mesh(requests: Sequence[_Comparison]) -> list[tuple[Tensor, Tensor]]:
    target = requests[0].target
    counts = [len(request.rotation) for request in requests]
    rotation = torch.cat([request.rotation for request in requests])
    distance = torch.cat([request.distance for request in requests])
    described = [request.descriptor.expand(len(request.rotation), -1) for request in requests]
    descriptors = torch.cat(described) if len(requests) > 1 else requests[0].descriptor
    if Appearance.name not in requests[0].ranking.terms:
        views = target.describer.descriptors(rotation, distance)
        similarity = similarities(views, descriptors)
        return [(part, torch.zeros_like(part)) for part in similarity.split(counts)]
    views, pictures = target.describer.described(rotation, distance)
    features = target.matcher.appearance_of(pictures)
    parts = zip(
        requests,
        similarities(views, descriptors).split(counts),
        features.split(counts),
        strict=True,
    )
    return [
        (part, target.matcher.appearance_score(request.query, request.ranking, pictures))
        for request, part, pictures in parts
    ]


def pose_features(
    poses: Poses,
    similarity: Tensor,
    appearance: Tensor | None = None,
    landmarks: Tensor | None = None,
) -> Tensor:
    """(H, 6) :data:`POSE_FEATURES` without details: the :func:`similarities`, the ``appearance``
    (H,) where the pipeline has that term, and the evidence of ``landmarks`` (H,) where the mesh has
    any."""
    appearance, landmarks = (
        torch.zeros_like(similarity) if x is None else x for x in (appearance, landmarks)
    )
    support = poses.edge_support.nan_to_num(0.0)
    details = torch.zeros_like(similarity)
    return torch.stack([poses.rank, similarity, support, appearance, landmarks, details], dim=1)


def with_details(
    describer: ViewDescriber,
    crops: EdgeCrops,
    poses: Poses,
    features: Tensor,
    best: int,
    rivals: Tensor,
) -> Tensor:
    """Features (H, F) in which ``rivals`` (R,) are compared in detail with the ``best`` pose."""
    index = torch.cat([torch.tensor([best]), rivals])
    some = poses[index]
    given = describer.device_contours, crops, some.cameras, some.T, some.crop_index
    scores, _ = details_together(*given)
    column = POSE_FEATURES.index("details")
    features = features.clone()
    features[rivals, column] = features[best, column] + scores[1:, 0].to(features)
    return features


def landmark_evidence(count: Tensor) -> Tensor:
    """(H,) the last of :data:`POSE_FEATURES`, for numbers of landmarks that agree."""
    return (count - CHANCE_LANDMARKS).clamp(min=0.0).log1p()


def pose_scores(features: Tensor, *, exact: bool) -> Tensor:
    """(H,) scores that order poses: of all features with an exact mesh, the order of the ranking
    with a similar one."""
    return features @ torch.tensor(SCORE_WEIGHTS if exact else RANK_ALONE, dtype=features.dtype)


def common_score(hypothesis: Hypothesis) -> float:
    """The part of the score that results in different boxes have in common: similarity and
    landmarks, weighted."""
    weights = dict(zip(POSE_FEATURES, SCORE_WEIGHTS, strict=True))
    return sum(weights[name] * hypothesis.evidence[name] for name in ("similarity", "landmarks"))


def distinct_poses(poses: Poses, score: Tensor, symmetries: Tensor | None = None) -> Tensor:
    """(H,) bool: False where a pose is within ``SAME_POSE_ANGLE`` degrees of one with a higher
    ``score`` (H,)."""
    order = score.argsort(descending=True, stable=True)
    R = poses.rotation[order].float()
    best_first = torch.arange(len(order))
    chosen = distinct_views(
        best_first, R, count=len(order), angle=SAME_POSE_ANGLE, symmetries=symmetries
    )
    return torch.zeros(len(order), dtype=torch.bool).index_fill(0, order[chosen], True)


def close_rivals(poses: Poses, scores: Tensor, symmetries: Tensor | None = None) -> Tensor:
    """(R,) indices of other poses whose scores (H,) are nearly as high as the best one, best
    first."""
    best = int(scores.argmax())
    same = are_near(poses.rotation, poses.rotation[best], symmetries)
    close = ~same & (scores > scores[best] - CLOSE_SCORE)
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


def named_features(features: Tensor, h: int) -> dict[str, float]:
    """Row ``h`` of :func:`pose_features`, by the names of :data:`POSE_FEATURES`."""
    return dict(zip(POSE_FEATURES, features[h].tolist(), strict=True))
