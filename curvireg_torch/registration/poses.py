"""Candidate poses under work: the best distinct views of rankings, lifted in front of cameras, fitted and judged."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..geometry.cameras import pose_from_box, projected_boxes, rotation_towards
from ..matching import Ranking, ViewBank, ViewDescriber, distinct_views
from .contour_fit import ContourFit, contour_support, fit_contours
from .result import Hypothesis
from .texture_fit import fit_texture, turned

__all__ = [
    "POSE_FEATURES",
    "SCORE_WEIGHTS",
    "Poses",
    "best_views",
    "distinct_poses",
    "edge_supports",
    "fit_poses",
    "fit_texture_of",
    "hypothesis_of",
    "lifted",
    "placed",
    "projected_box",
    "similarities",
]

SAME_POSE_ANGLE = 15.0
"""Degrees within which two fitted hypotheses count as one."""

FINISHED_FITS = 2
"""Hypotheses of a photograph whose contours are fitted at full size."""

POSE_FEATURES = ("rank", "similarity", "edge_support", "appearance")
"""Features of a pose: log S of the view it started from, minus that of the best view; normalised correlation of the
pose's view with the photograph; edge support (0 without the contour fit); log appearance score of the pose (0 without
that term)."""

SCORE_WEIGHTS, RANK_ALONE = (1.0, 10.0, 10.0, 2.5), (1.0, 0.0, 0.0, 0.0)
"""Weights of the features in the score of a pose, with an exact mesh and with a similar one (docs/experiments.md)."""


@dataclass(frozen=True)
class Poses:
    """H candidate poses of the object in photographs; those of one photograph are adjacent.

    Attributes:
        image_index: (H,) int64, ascending.
        view: (H,) int64 view of the bank that the pose started from.
        rank: (H,) float64 log S of that view, minus that of the photograph's best view.
        rotation: (H, 3, 3) float64 allocentric rotations.
        distance: (H,) float64 of the object's centre, model units.
        T: (H, 4, 4) float64 ``T_cam_from_model``.
        cameras: (H, 3, 3) float64 in px of the photographs.
        covariance: (H, 6, 6) of a fit, NaN without one, see :func:`fit_contours`.
        edge_support, start_support: (H,) of a fit, NaN without one.
        observable: (H,) number of directions that a fit determines.
    """

    image_index: Tensor
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

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, index: Tensor) -> "Poses":
        return Poses(*(getattr(self, f.name)[index] for f in fields(Poses)))

    @staticmethod
    def cat(parts: "Sequence[Poses]") -> "Poses":
        """Return all poses, in the order of their photographs."""
        joined = Poses(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Poses)))
        return joined[joined.image_index.argsort(stable=True)]

    def with_fit(self, fit: ContourFit, centre: Tensor) -> "Poses":
        """Return the poses of a fit, for an object with this centre (3,)."""
        fitted = replace(
            self,
            covariance=fit.covariance,
            edge_support=fit.edge_support,
            start_support=fit.start_support,
            observable=fit.observable,
        )
        return placed(fitted, fit.transform, centre)

    def replaced(self, index: Tensor, others: "Poses") -> "Poses":
        """Return these poses with ``others`` in the places ``index``."""
        return Poses(*(getattr(self, f.name).index_copy(0, index, getattr(others, f.name)) for f in fields(Poses)))

    @property
    def fit(self) -> ContourFit:
        """The poses as a fit."""
        return ContourFit(self.T, self.covariance, self.edge_support, self.start_support, self.observable)


def best_views(
    ranking: Ranking, bank: ViewBank, *, count: int, symmetries: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """At most ``count`` best distinct views of every photograph: image index, view and rank, each (H,), on the CPU.

    Where limits on the pose leave views out, the best view outside them comes last, as a rival.
    """
    chosen: list[list[int]] = []
    for b, order in enumerate(ranking.order):
        if ranking.allowed is not None:
            order = order[ranking.allowed[b][order]]
        views = distinct_views(order, bank.rotations, count=count, symmetries=symmetries)
        chosen.append(views.tolist())
    image_index = torch.tensor([b for b, views in enumerate(chosen) for _ in views], dtype=torch.long)
    view = torch.tensor([v for views in chosen for v in views], dtype=torch.long)
    log = ranking.scores.cpu().double().clamp(min=torch.finfo(torch.float64).tiny).log()
    return image_index, view, log[image_index, view] - log.amax(dim=1)[image_index]


def lifted(
    describer: ViewDescriber,
    image_index: Tensor,
    view: Tensor,
    rank: Tensor,
    rotation: Tensor,
    distance: Tensor,
    boxes: Tensor,
    K: Tensor | None,
) -> Poses:
    """Poses of allocentric rotations (H, 3, 3) that fill the photographs' boxes (B, 4).

    Without ``K`` (B, 3, 3), cameras look straight at the boxes from ``distance`` (H,).
    """
    if K is None:
        T, cameras = describer.cameras_of_boxes(rotation, distance, boxes[image_index])
    else:
        cameras = K[image_index]
        T = torch.eye(4, dtype=torch.float64).repeat(len(view), 1, 1)
        T[:, :3, :3], T[:, :3, 3] = pose_from_box(describer.hull, rotation, boxes[image_index], cameras)
    nan = torch.full((len(view),), torch.nan, dtype=torch.float64)
    poses = Poses(
        image_index=image_index,
        view=view,
        rank=rank,
        rotation=rotation,
        distance=distance,
        T=T,
        cameras=cameras,
        covariance=nan[:, None, None].repeat(1, 6, 6),
        edge_support=nan,
        start_support=nan,
        observable=torch.zeros_like(view),
    )
    return poses if K is None else placed(poses, T, describer.centre)


def placed(poses: Poses, T: Tensor, centre: Tensor) -> Poses:
    """Return the poses at ``T`` (H, 4, 4), with allocentric rotations and distances to match."""
    position = T[:, :3, :3] @ centre + T[:, :3, 3]
    rotation = rotation_towards(position).mT @ T[:, :3, :3]
    return replace(poses, T=T, rotation=rotation, distance=torch.linalg.vector_norm(position, dim=1))


def fit_poses(
    describer: ViewDescriber,
    images: Sequence[Tensor],
    poses: Poses,
    boxes: Tensor,
    object_mask: Tensor | None = None,
    **options: Any,
) -> Poses:
    """Fit the contours of all poses, see :func:`fit_contours`, which has more ``options``."""
    fit = fit_contours(
        describer.contours,
        images,
        boxes,
        poses.cameras,
        poses.T,
        image_index=poses.image_index,
        margin=describer.settings.margin,
        object_mask=object_mask,
        **{"finish": FINISHED_FITS, **options},
    )
    return poses.with_fit(fit, describer.centre)


def fit_texture_of(
    describer: ViewDescriber, images: Sequence[Tensor], poses: Poses, boxes: Tensor, h: int
) -> Poses | None:
    """Pose ``h``, fitted to the colours of its mesh too, see :func:`fit_texture`; None without colours or fit."""
    if not describer.draws_colours:
        return None
    one = poses[torch.tensor([h])]
    b = int(one.image_index)
    fit = fit_texture(
        describer.draw,
        describer.renderer,
        describer.contours,
        [images[b]],
        boxes[b : b + 1],
        one.cameras,
        turned(one.fit, describer.centre),
        image_index=torch.zeros(1, dtype=torch.long),
        margin=describer.settings.margin,
    )
    return None if fit is None else one.with_fit(fit, describer.centre)


def edge_supports(describer: ViewDescriber, images: Sequence[Tensor], poses: Poses, boxes: Tensor) -> Tensor:
    """(H,) edge support of poses that are not fitted, see :func:`contour_support`."""
    margin = describer.settings.margin
    given = (describer.contours, images, boxes, poses.cameras, poses.T)
    return contour_support(*given, image_index=poses.image_index, margin=margin)


def similarities(describer: ViewDescriber, descriptors: Tensor, poses: Poses) -> Tensor:
    """(H,) normalised correlations of the poses' views with their photographs, of (B, D) descriptors."""
    queries = F.normalize(descriptors, dim=1)[poses.image_index.to(descriptors.device)]
    views = describer.descriptors(poses.rotation, poses.distance)
    return (F.normalize(views, dim=1) * queries).sum(dim=1).double().cpu()


def distinct_poses(poses: Poses, score: Tensor, symmetries: Tensor | None = None) -> Tensor:
    """(H,) bool: False where a pose is within ``SAME_POSE_ANGLE`` degrees of one with a higher ``score`` (H,)."""
    distinct = torch.zeros(len(poses), dtype=torch.bool)
    order = score.argsort(descending=True, stable=True)
    for b in poses.image_index.unique():
        own = order[poses.image_index[order] == b]
        R, best_first = poses.rotation[own].float(), torch.arange(len(own))
        chosen = distinct_views(best_first, R, count=len(own), angle=SAME_POSE_ANGLE, symmetries=symmetries)
        distinct[own[chosen]] = True
    return distinct


def projected_box(describer: ViewDescriber, projection: tuple[Tensor, Tensor]) -> Tensor:
    """(4,) float64 box around the projected mesh, px of the photograph."""
    T, K = projection
    return projected_boxes(describer.hull, T[None], K)[0]


def hypothesis_of(poses: Poses, h: int, evidence: Tensor, *, with_camera: bool) -> Hypothesis:
    """Pose ``h`` with its (H, 4) :data:`POSE_FEATURES`, as it is reported."""
    T = poses.T[h]
    features = dict(zip(POSE_FEATURES, evidence[h].tolist(), strict=True))
    is_fitted, known = bool(poses.edge_support[h].isfinite()), bool(poses.covariance[h].isfinite().all())
    return Hypothesis(
        rotation=T[:3, :3].clone() if with_camera else poses.rotation[h].clone(),
        translation=T[:3, 3].clone() if with_camera else None,
        score=features["similarity"],
        evidence=features,
        allocentric_rotation=poses.rotation[h].clone(),
        distance=float(poses.distance[h]),
        projection=(T.clone(), poses.cameras[h].clone()),
        view=int(poses.view[h]),
        edge_support=features["edge_support"] if is_fitted else None,
        covariance=poses.covariance[h].clone() if known and with_camera else None,
    )
