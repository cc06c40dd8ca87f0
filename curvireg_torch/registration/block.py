"""Photographs under work together, and how their poses are limited, compared and fitted."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import InvalidInputError
from ..evidence import Evidence
from ..fitting.details import compared, contour_details
from ..fitting.edges import EdgeCrops
from ..fitting.keypoints import KeypointMatches
from ..fitting.measured_fit import edges_at, measure_contours
from ..geometry.cameras import point_in_cameras, pose_around, rotation_towards
from ..geometry.framing import CropFrame, shown_in
from ..geometry.pose_prior import object_frame
from ..matching import Ranking, ViewBank
from ..mesh.mesh import mesh_centre, mesh_radius
from ..terms import Appearance, QueryFeatures
from .hypotheses import (
    Hypotheses,
    best_views,
    by_contours,
    close_rivals,
    distinct_poses,
    fit_poses,
    placed,
)
from .photograph import Photograph
from .target import Target, nearest_view

# Degrees by which the limits are widened for views of a bank: each stands for the poses up to
# halfway to the next
VIEW_SPACING = 7.5
# Degrees by which the contour fit may leave the limits: it measures more precisely than limits are
# usually known
FIT_TOLERANCE = 3.0
AT_LIMIT_ANGLE = 1.0  # Degrees from a limit within which a result is reported to lie at the limit
# The same two for the distance, as fractions of its limits
DISTANCE_TOLERANCE = 0.03
AT_LIMIT_DISTANCE = 0.01
# Fraction of a limit by which the distance at which the mesh fills the box may miss it: boxes are
# not exact
BOX_DISTANCE_TOLERANCE = 0.1


BLOCK = {"cpu": 16}
"""Photographs in a block by the kind of device; their crops and pictures are in memory together.
Measured on a CPU, 16 photographs of one mesh: blocks of 16 take 9 to 12 % less processor time than
blocks of 8, and 4 to 8 % more memory (1.14 GB at 640 x 480, 1.71 GB at 4000 x 3000)."""
BLOCK_OF_DEVICE = 64


def block_size(device: str) -> int:
    """Photographs in a block on a kind of device."""
    return BLOCK.get(device, BLOCK_OF_DEVICE)


def share_of_worker(photographs: int, workers: int, device: str = "cpu") -> int:
    """How many of some photographs a worker gets at a time: a block, or fewer, so that each gets
    two shares.

    Example:
        >>> share_of_worker(100, 2), share_of_worker(12, 2)
        (16, 3)
    """
    return max(1, min(block_size(device), photographs // (2 * workers)))


class Limits:
    """The limits of a photograph's ``prior``, for rotations in its own camera; without a camera
    matrix, in one that looks straight at the box. Views are allocentric, and are rotated towards
    the ray through the centre of the box, which is known to ``off_centre`` degrees."""

    def __init__(self, item: Photograph, bank: ViewBank, *, off_centre: float = 0.0) -> None:
        assert item.prior is not None
        self._off_centre = off_centre
        self.prior = item.prior
        self._bank = bank
        self._frame = object_frame(bank.mesh.up, item.prior.front)
        self._centre = mesh_centre(bank.mesh)
        self._towards = torch.eye(3, dtype=torch.float64)
        if item.camera is not None:
            centre = (item.box[:2] + item.box[2:]).double() / 2.0
            ray = torch.linalg.solve(item.K, F.pad(centre, (0, 1), value=1.0))
            self._towards = rotation_towards(ray)

    def allowed(self, *, off_centre: float = 0.0) -> Tensor:
        """(N,) bool: views of the bank within the limits; the object may lie ``off_centre`` degrees
        from the ray through its box. Refuses limits that leave no view, or only distances inside
        the object."""
        radius = mesh_radius(self._bank.mesh)
        distance = self.prior.distance
        if distance is not None and distance[1] < radius:
            raise InvalidInputError(
                f"distance: at most {distance[1]:g} from the centre, the camera is inside the "
                f"object, "
                f"whose radius is {radius:.3g}; give distances in the mesh's unit"
            )
        excess = self.prior.excess(self._towards @ self._bank.rotations.cpu().double(), self._frame)
        allowed = excess <= VIEW_SPACING + self._off_centre + off_centre + 1e-4
        if not bool(allowed.any()):
            message = (
                f"no view of the bank lies within {self.prior.to_dict()}; widen it, or leave it out"
            )
            raise InvalidInputError(f"prior: {message}")
        return allowed

    def moved_inside(self, poses: Hypotheses) -> Hypotheses:
        """Poses turned about the object's centre, and moved along the ray through it, as far as
        limits ask for."""
        beyond = self._excess(poses) > 0.0
        far = self._distance_excess(poses) > 0.0
        if not bool((beyond | far).any()):
            return poses
        centre = self._positions(poses.T)
        if self.prior.distance is not None:
            away = torch.linalg.vector_norm(centre, dim=1, keepdim=True)
            centre = (
                torch.where(far[:, None], away.clamp(*self.prior.distance) / away, 1.0) * centre
            )
        R = poses.T[:, :3, :3]
        R = torch.where(beyond[:, None, None], self.prior.nearest(R, self._frame), R)
        moved = pose_around(R, centre, self._centre)
        T = torch.where((beyond | far)[:, None, None], moved, poses.T)
        return placed(poses, T, self._centre)

    def keeps(self, poses: Hypotheses) -> Tensor:
        """(H,) bool: whether poses leave the limits by no more than the tolerances."""
        return (self._excess(poses) <= FIT_TOLERANCE) & (
            self._distance_excess(poses) <= DISTANCE_TOLERANCE
        )

    def contradiction(
        self, best: Hypotheses, filling: Hypotheses, *, better_outside: bool
    ) -> str | None:
        """See :attr:`Registration.prior_contradiction`, of the best pose; ``filling`` is the same
        at the distance at which the mesh fills the box, ``better_outside`` whether a pose outside
        has a higher score."""
        if better_outside or bool(self._distance_excess(filling) > BOX_DISTANCE_TOLERANCE):
            return "better outside"
        at_limit = (
            self._excess(best) > -AT_LIMIT_ANGLE,
            self._distance_excess(best) > -AT_LIMIT_DISTANCE,
        )
        return "at the limit" if any(map(bool, at_limit)) else None

    def _excess(self, poses: Hypotheses) -> Tensor:
        """(H,) degrees by which rotations in the photograph's camera miss the limits, negative
        within."""
        return self.prior.excess(poses.T[:, :3, :3], self._frame)

    def _distance_excess(self, poses: Hypotheses) -> Tensor:
        """(H,) fractions by which the distances of poses miss their limits, negative within; -1
        without limits."""
        away = torch.linalg.vector_norm(self._positions(poses.T), dim=1)
        if self.prior.distance is None:
            return torch.full_like(away, -1.0)
        near, far = self.prior.distance
        return torch.maximum(1.0 - away / near, away / far - 1.0)

    def _positions(self, T: Tensor) -> Tensor:
        """(H, 3) positions of the object's centre in the camera."""
        return point_in_cameras(T, self._centre)


BACKGROUND = 1.0  # of pictures of the mesh


@dataclass(frozen=True, kw_only=True)
class Described:
    """P photographs as poses are compared with them.

    Attributes:
        query: their boxes, described by the matcher.
        rankings: of the views of the bank, one for each photograph.
        descriptor: (P, D) on a grid twice as fine as the bank's.
        crops: of the boxes, for contour fits; None without them.
        keypoints: those found in each box; None where they do not count.
        frames: in which poses are compared with each photograph; None: each fills a picture by
            itself, as a view of the bank does.
    """

    query: QueryFeatures
    rankings: Sequence[Ranking]
    descriptor: Tensor
    crops: EdgeCrops | None
    keypoints: Sequence[KeypointMatches | None]
    frames: Sequence[CropFrame | None]

    def printed(self, photograph: int) -> float:
        """log (1 + n) with the number n of keypoints that a view of the mesh has; 0 where they do
        not count in a photograph."""
        keypoints = self.keypoints[photograph]
        return 0.0 if keypoints is None else math.log1p(keypoints.per_view)


def described(
    target: Target,
    photographs: Sequence[Photograph],
    query: QueryFeatures,
    rankings: Sequence[Ranking],
    *,
    contours: bool,
    keypoints: bool = True,
) -> Described:
    """Photographs in their boxes, which the matcher has described as ``query`` and ranked; with
    crops for ``contours``, and ``keypoints``."""
    crops = None
    if contours:
        mask = target.object_mask(query, photographs)
        images = [item.image for item in photographs]
        boxes = torch.stack([item.box for item in photographs]).float()
        shown = torch.stack([target.shown_around(item.box, item.size) for item in photographs])
        crops = EdgeCrops.cut(images, boxes, target.bank.settings.margin, mask, shown=shown)
    frames = [target.frame_of(item.box, item.size) for item in photographs]
    fields = [shown_in(frame, field) for frame, field in zip(frames, query.field, strict=True)]
    return Described(
        query=query,
        rankings=rankings,
        descriptor=target.describer.descriptor(torch.stack(fields)),
        crops=crops,
        keypoints=[
            target.keypoint_matches(item, item.box) if keypoints and target.uses_keypoints else None
            for item in photographs
        ],
        frames=frames,
    )


@torch.no_grad()
def evidence_of(target: Target, described: Described, poses: Hypotheses) -> Evidence:
    """The evidence of poses in their photographs, without details."""
    views, features = _views(target, described, poses)
    descriptor = F.normalize(described.descriptor, dim=1)[poses.photograph.to(views.device)]
    similarity = (F.normalize(views, dim=1) * descriptor).sum(dim=1).double().cpu()
    return Evidence.measured(
        rank=poses.rank,
        similarity=similarity,
        edge_support=poses.edge_support,
        appearance=_appearance(target, described, poses, features),
        keypoints=counting_keypoints(target, described, poses),
        contours=_contours(target, described, poses),
    )


def with_evidence(target: Target, described: Described, poses: Hypotheses) -> Hypotheses:
    """Poses with their :func:`evidence_of`."""
    return replace(poses, evidence=evidence_of(target, described, poses))


def _views(target: Target, described: Described, poses: Hypotheses) -> tuple[Tensor, Tensor | None]:
    """(N, D) descriptors of the poses' views, and the features (N, F) of their pictures where the
    appearance counts."""
    has_frame = torch.tensor([frame is not None for frame in described.frames])
    in_frame = has_frame[poses.photograph] if len(has_frame) else poses.is_outside
    parts = [part for part in (~in_frame, in_frame) if bool(part.any())] or [~in_frame]
    found = [_views_alike(target, described, poses[part]) for part in parts]
    views = torch.cat([view for view, _ in found])
    features = [feature for _, feature in found if feature is not None]
    together = torch.cat(features) if features else None
    if len(parts) == 1:
        return views, together
    back = torch.cat([part.nonzero()[:, 0] for part in parts]).argsort().to(views.device)
    return views[back], None if together is None else together[back]


def _views_alike(
    target: Target, described: Described, poses: Hypotheses
) -> tuple[Tensor, Tensor | None]:
    """The same of poses that are all compared in frames, or all by themselves."""
    frames = [
        frame
        for frame in (described.frames[p] for p in poses.photograph.tolist())
        if frame is not None
    ]
    shaded = bool(described.rankings) and Appearance.name in described.rankings[0].terms
    if frames:
        T = poses.T
        K = torch.stack([frame.transform for frame in frames]) @ poses.cameras
    else:
        T, K, _ = target.describer.cameras(poses.rotation, poses.distance)
    fields, pictures = target.describer.seen_by(T, K, shaded=shaded)
    if frames:
        inside = torch.stack([frame.inside for frame in frames]).to(fields.device)
        fields = fields * inside
        pictures = None if pictures is None else pictures.masked_fill(~inside, BACKGROUND)
    views = target.describer.descriptor(fields)
    return views, None if pictures is None else target.matcher.appearance_of(pictures)


def _appearance(
    target: Target, described: Described, poses: Hypotheses, features: Tensor | None
) -> Tensor:
    """(N,) log appearance scores; 0 without that term."""
    if features is None:
        return torch.zeros(len(poses), dtype=torch.float64)
    return target.matcher.appearance_scores(
        described.query, described.rankings, features, poses.photograph
    )


def counting_keypoints(target: Target, described: Described, poses: Hypotheses) -> Tensor:
    """(N,) number of keypoints that agree with poses, beyond those that agree by chance."""
    count = _agreeing_keypoints(described, poses)
    return (count - target.pipeline.fit.chance_keypoints).clamp(min=0.0)


def _agreeing_keypoints(described: Described, poses: Hypotheses) -> Tensor:
    """(N,) float64 number of keypoints that agree with poses."""
    count = torch.zeros(len(poses), dtype=torch.float64)
    for photograph, keypoints in enumerate(described.keypoints):
        rows = poses.of(photograph) if keypoints is not None else None
        if rows is not None and keypoints is not None and len(rows):
            agreeing = keypoints.agreeing(poses.T[rows], poses.cameras[rows])
            count[rows] = agreeing.to(count)
    return count


def _contours(target: Target, described: Described, poses: Hypotheses) -> Tensor:
    """(N,) see :func:`.edge_excess`, measured where it is not known; 0 without the contour fit."""
    if described.crops is None:
        return torch.zeros(len(poses), dtype=torch.float64)
    excess = poses.edge_excess
    unknown = excess.isnan().nonzero()[:, 0]
    if not len(unknown):
        return excess
    _, measured = by_contours(edges_at, target.describer, described.crops, poses[unknown])
    return excess.index_copy(0, unknown, measured)


def with_details(
    target: Target, crops: EdgeCrops, poses: Hypotheses, best: Tensor, rivals: Tensor
) -> Hypotheses:
    """Poses whose ``rivals`` (R,) are compared in detail with the best one (P,) of the same
    photograph."""
    index = torch.cat([best, rivals])
    some = poses[index]
    seen = by_contours(contour_details, target.describer, crops, some)
    details = poses.evidence.details.clone()
    for place, row in enumerate(best.tolist()):
        others = (some.photograph == poses.photograph[row]).nonzero()[:, 0]
        others = others[others >= len(best)]
        if len(others):
            scores, _ = compared(seen[torch.cat([torch.tensor([place]), others])])
            details[index[others]] = details[row] + scores[1:, 0].to(details)
    return replace(poses, evidence=replace(poses.evidence, details=details))


@dataclass(frozen=True, kw_only=True)
class Block(Described):
    """P photographs under work.

    Attributes:
        photographs: what is known of each.
        limits: of the poses in each, if there are any.
        exact: whether the mesh is that of this very object.
        symmetries: (S, 4, 4) of the object, or None.
        tried_cameras: (P,) bool, photographs whose camera is unknown: their starts have several.
    """

    photographs: Sequence[Photograph]
    limits: Sequence[Limits | None]
    exact: bool
    symmetries: Tensor | None
    tried_cameras: Tensor

    def __len__(self) -> int:
        return len(self.photographs)

    @property
    def boxes(self) -> Tensor:
        """(P, 4) float64."""
        return torch.stack([photograph.box for photograph in self.photographs]).double()

    @property
    def cameras(self) -> Tensor:
        """(P, 3, 3) float64 camera matrices, NaN where they are unknown."""
        unknown = torch.full((3, 3), torch.nan, dtype=torch.float64)
        return torch.stack([unknown if one.camera is None else one.K for one in self.photographs])

    def with_photographs(self, changed: dict[int, Photograph]) -> "Block":
        """The block with other photographs in some places."""
        photographs = [changed.get(p, one) for p, one in enumerate(self.photographs)]
        return replace(self, photographs=photographs)

    def moved_inside(self, poses: Hypotheses) -> Hypotheses:
        """Poses, moved into the limits of their photographs."""
        for p, limits in enumerate(self.limits):
            if limits is not None and len(rows := poses.of(p)):
                poses = poses.replaced(rows, limits.moved_inside(poses[rows]))
        return poses

    def keeps(self, poses: Hypotheses) -> Tensor:
        """(N,) bool: whether poses leave the limits of their photographs by no more than the
        tolerances."""
        kept = torch.ones(len(poses), dtype=torch.bool)
        for p, limits in enumerate(self.limits):
            if limits is not None and len(rows := poses.of(p)):
                kept[rows] = limits.keeps(poses[rows])
        return kept


def least_starts(target: Target) -> int:
    return max(target.pipeline.fit.least_hypotheses, target.pipeline.hypotheses)


def poses_of_views(
    target: Target,
    block: Block,
    view: Tensor,
    rank: Tensor,
    photograph: Tensor,
    *,
    boxes: Tensor | None = None,
    cameras: Tensor | None = None,
) -> Hypotheses:
    """Views (N,) of the bank put into the boxes of their photographs (N,), or into other ``boxes``
    (N, 4) of these, by the photographs' cameras or others (N, 3, 3)."""
    rotation = target.bank.rotations.cpu()[view].double()
    distance = target.bank.distances.cpu()[view]
    return Hypotheses.in_boxes(
        target.describer,
        block.boxes[photograph] if boxes is None else boxes,
        block.cameras[photograph] if cameras is None else cameras,
        rotation,
        distance,
        view,
        rank,
        photograph,
    )


def poses_of_best_views(
    target: Target,
    block: Block,
    rankings: Sequence[Ranking],
    places: Sequence[int],
    boxes: Tensor,
    counts: Sequence[int],
) -> Hypotheses:
    """Poses of the best distinct views of each of R rankings, R ``counts`` of them, of the
    photographs ``places`` with ``boxes`` (R, 4)."""
    found = [
        best_views(ranking, target.bank, count=count, symmetries=block.symmetries)
        for ranking, count in zip(rankings, counts, strict=True)
    ]
    which = torch.arange(len(places)).repeat_interleave(
        torch.tensor([len(view) for view, _ in found], dtype=torch.long)
    )
    no_view = torch.zeros(0, dtype=torch.long)
    view = torch.cat([no_view, *(view for view, _ in found)])
    rank = torch.cat([no_view.double(), *(rank for _, rank in found)])
    photograph = torch.tensor(places, dtype=torch.long)[which]
    poses = poses_of_views(target, block, view, rank, photograph, boxes=boxes[which])
    return block.moved_inside(poses)


def keypoint_poses(target: Target, matches: KeypointMatches | None) -> tuple[Hypotheses, Tensor]:
    """Poses on which keypoints agree, as promising as the best view, and how many, the largest
    number first.

    :meta private:
    """
    T = torch.zeros(0, 4, 4, dtype=torch.float64)
    count = torch.zeros(0)
    K = torch.eye(3, dtype=torch.float64)
    if matches is not None:
        T, count = matches.poses()
        K = torch.from_numpy(matches.K)
    none = torch.zeros(len(T))
    cameras = K.expand(len(T), 3, 3)
    poses = Hypotheses.at(T, cameras, target.describer.centre, none.long(), none.double())
    views = torch.tensor([nearest_view(target, R) for R in poses.rotation], dtype=torch.long)
    return replace(poses, view=views), count


def fitted_poses(
    target: Target, block: Block, crops: EdgeCrops, starts: Hypotheses, **options: Any
) -> Hypotheses:
    """Fit the contours of ``starts``; one keeps its pose if the fit leaves the keypoints that
    agree with it."""
    settings = target.pipeline.fit
    poses = fit_poses(target.describer, crops, starts, settings=settings, **options)
    if all(keypoints is None for keypoints in block.keypoints):
        return poses
    before = _agreeing_keypoints(block, starts)
    after = _agreeing_keypoints(block, poses)
    is_left = (before >= settings.min_keypoints) & (after < settings.kept_keypoints * before)
    left = is_left.nonzero()[:, 0]
    if not len(left):
        return poses
    kept = starts[left]
    seen = by_contours(measure_contours, target.describer, crops, kept)
    return poses.replaced(left, kept.with_fit(seen, target.describer.centre))


def refitted(target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses) -> Hypotheses:
    """Fit the best pose of each photograph again from where it is, then its close rivals: fits that
    differ in effort cannot be compared. Results with a higher score are kept."""
    weights = target.score_weights(exact=True)
    best = poses.best(weights)
    poses = _refitted(target, block, crops, poses, best)
    scores = poses.scores(weights)
    settings = target.pipeline.fit
    close = []
    different = []
    for photograph in poses.photograph[best].tolist():
        rows = poses.of(photograph)
        rivals = rows[
            close_rivals(
                poses.rotation[rows], scores[rows], block.symmetries, behind=settings.close_score
            )
        ]
        distinct = distinct_poses(
            poses.rotation[rivals],
            scores[rivals],
            block.symmetries,
            angle=settings.same_pose_angle,
        )
        close.append(rivals)
        different.append(rivals[distinct][: settings.close_rivals])
    rivals = torch.cat(close)
    if not len(rivals):
        return poses
    poses = _refitted(target, block, crops, poses, torch.cat(different))
    return with_details(target, crops, poses, best, rivals)


def _refitted(
    target: Target, block: Block, crops: EdgeCrops, poses: Hypotheses, index: Tensor
) -> Hypotheses:
    """Fit poses again, and keep the results that have a higher score."""
    if not len(index):
        return poses
    before = poses[index]
    fitted = fitted_poses(target, block, crops, before, refit=True)
    moved = (before.T != fitted.T).flatten(1).any(dim=1).nonzero()[:, 0]
    if not len(moved):
        return poses
    new = with_evidence(target, block, fitted[moved])
    weights = target.score_weights(exact=True)
    higher = new.evidence.scores(weights) > before.evidence.scores(weights)[moved]
    better = (higher & block.keeps(new)).nonzero()[:, 0]
    return poses.with_poses(index[moved[better]], new[better])
