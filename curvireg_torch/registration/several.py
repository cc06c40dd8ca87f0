"""One pose from several photographs: candidates of each are compared, and fitted to contours, in all of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..filters.operations import fill_missing
from ..geometry.cameras import rotation_towards, transform
from ..geometry.crops import box_iou, crop_transforms, square_boxes
from ..terms import Appearance, QueryFeatures, crop_regions
from ..utils.checks import as_camera_matrices, as_numbers, check_pose, check_tensor
from .confidence import (
    MAX_MARGIN,
    confidence_features,
    hypothesis_probabilities,
    is_calibrated,
    refinement_confidence,
    registration_confidence,
)
from .contour_fit import (
    CROP_SIZE,
    FIRST_RADII,
    FULL_SIZE_RADII,
    QUARTER_SIZE_RADII,
    ContourProblem,
    ContourState,
    EdgeField,
    ObjectMask,
    inside_photographs,
    smaller_problem,
)
from .detection import detect
from .inputs import ImageItem, OnDemand, image_items
from .least_squares import Information, pose_information
from .poses import POSE_FEATURES, RANK_ALONE, SCORE_WEIGHTS
from .refinement import LOST_CONFIDENCE, nearest_view
from .result import FailedRegistration, Hypothesis, PhotographPose, Registration
from .tracker import boxes_at

if TYPE_CHECKING:
    from .registrar import Registrar

__all__ = ["register_views"]

MAX_CANDIDATES, FINISHED_CANDIDATES = 6, 2
"""World poses that are fitted in all photographs, and those that are fitted at full size."""

SAME_ANGLE, SAME_SHIFT = 15.0, 0.5
"""Degrees, and shift in object radii, within which two candidates count as one."""

NEAR_VIEW_ANGLE = 15.0
"""Degrees within which the best of the bank's views stands for a pose."""

DEPTH_ERROR, RIG_ERROR, CENTRE_ERROR = 0.08, 0.01, 0.1
"""Standard deviations of an object's place from one photograph: along its ray and across it, as fractions of the
distance, and across it in object radii."""

MAX_PLACE_DISTANCE = 16.0
"""Squared Mahalanobis distance up to which two photographs see the object in the same place."""

MIN_OVERLAP = 0.3
"""Overlap (IoU) with the box of a photograph below which a pose lies elsewhere."""

SAME_DIRECTION = 10.0
"""Degrees within which two photographs show partly the same; their weights add up to one if they are equal."""

UNIT_FACTOR = 30.0
"""Factor between an object's distance from its size and from the rays of the cameras that is a mistake in the unit."""

SAME_PICTURE = 0.8
"""Correlation of small copies of two photographs from which they may come from the same place."""

MIN_PARALLAX = 0.03
"""Root mean square sine of the angles between rays and their mean direction from which they tell a distance."""

WHOLE_IMAGE = [-0.5, -0.5, 1e5, 1e5]
"""A box around any photograph."""

ELSEWHERE = "where the other photographs have the object, it lies outside this one or its box"


@dataclass(frozen=True, kw_only=True)
class RigProblem(ContourProblem):
    """Poses of several photographs that are tied together: those with the same number in ``group`` (N,) are one pose in
    the world, seen by cameras with ``axes`` (N, 3, 3), rotations from the world."""

    axes: Tensor
    group: Tensor

    def __getitem__(self, index: Tensor) -> "RigProblem":
        image_index, K, axes, group = (x[index] for x in (self.image_index, self.K, self.axes, self.group))
        return replace(self, image_index=image_index, K=K, axes=axes, group=group)

    @cached_property
    def frames(self) -> Tensor:
        """(N, 6, 6) from twists along the world's axes to those along the cameras'."""
        return torch.stack([torch.block_diag(R, R) for R in self.axes])

    def solution(self, A: Tensor, b: Tensor) -> Tensor:
        P = self.frames
        A, b = (self.summed(x) for x in (P.mT @ A @ P, P.mT @ b))
        return (P @ super().solution(A, b)[self.group, :, None])[..., 0]

    def step_fraction(self, step: Tensor, T: Tensor) -> Tensor:
        fraction = super().step_fraction(step, T)
        least = torch.ones(int(self.group.max()) + 1, dtype=T.dtype)
        return least.scatter_reduce(0, self.group, fraction, "amin")[self.group]

    def summed(self, x: Tensor) -> Tensor:
        """(G, ...) sums of (N, ...) over the photographs of each pose."""
        return x.new_zeros(int(self.group.max()) + 1, *x.shape[1:]).index_add(0, self.group, x)

    def information(self, state: ContourState, weights: Tensor) -> Information:
        """What the edges of all photographs tell of each pose, along the world's axes; (N,) weights."""
        measured = self.measured_edges(state, FULL_SIZE_RADII[-1])
        one = pose_information(measured, state.points, state.T, self.K, self.centre, radius=self.contours.radius)
        P = self.frames
        A, E, B = (self.summed(weights[:, None, None] * (P.mT @ x @ P)) for x in (one.A, one.E, one.B))
        return Information(A, E, B, self.summed(one.weight))


@dataclass(frozen=True)
class _Photograph:
    """A registered photograph ``index`` of a rig: its ``camera`` (4, 4) from the world, ``K`` (3, 3) and ``size``; the
    ``box`` (4,) in which poses are compared, the crops of it, and the registration of it alone."""

    index: int
    camera: Tensor
    K: Tensor
    size: tuple[int, int]
    box: Tensor
    crop: Tensor
    inside: Tensor
    query: QueryFeatures
    descriptor: Tensor
    mask: Tensor | None
    result: Registration

    @classmethod
    def of(
        cls, registrar: "Registrar", item: ImageItem, result: Registration, index: int, camera: Tensor
    ) -> "_Photograph":
        box = item.box.double() if result.corrected_box is None else result.corrected_box
        settings, boxes = registrar.bank.settings, box.float()[None]
        image = item.image.expand(3, -1, -1)
        assert item.camera_matrix is not None

        def crop(size: int) -> Tensor:
            return crop_regions([image], boxes[:, None], size=size, margin=settings.margin)[:, 0].float()

        query = registrar.matcher.features(crop(settings.image_size).to(registrar.bank.device))
        return cls(
            index=index,
            camera=camera,
            K=item.camera_matrix.double(),
            size=item.size,
            box=box,
            crop=fill_missing(crop(CROP_SIZE)),
            inside=inside_photographs([image], boxes, CROP_SIZE, settings.margin),
            query=query,
            descriptor=F.normalize(registrar.describer.descriptor(query.field), dim=1),
            mask=registrar.object_mask(query, [replace(item, box=box)]),
            result=result,
        )

    @property
    def poses(self) -> Tensor:
        """(H, 4, 4) ``T_world_from_model`` of its hypotheses."""
        found = [h.transform for h in self.result.hypotheses if h.transform is not None]
        return torch.cat([torch.linalg.solve(self.camera, T)[None] for T in found])

    def sees(self, hull: Tensor, T: Tensor) -> Tensor:
        """(N,) bool: whether world poses (N, 4, 4) lie near the box."""
        boxes, visible = boxes_at(hull, self.camera @ T, self.K, self.size)
        return visible & (box_iou(boxes, self.box[None].to(boxes))[:, 0] >= MIN_OVERLAP)


@dataclass(frozen=True)
class _Answer:
    """M candidate poses in the world, best first, with ``evidence`` (V, M, 4) and ``scores`` (V, M) in V photographs;
    ``sees`` (V, M) is False where a pose lies elsewhere; covariances (M, 6, 6), NaN for those that are not finished."""

    T: Tensor
    evidence: Tensor
    scores: Tensor
    sees: Tensor
    covariance: Tensor

    def __getitem__(self, index: Tensor) -> "_Answer":
        parts = (self.evidence[:, index], self.scores[:, index], self.sees[:, index])
        return _Answer(self.T[index], *parts, self.covariance[index])


_Found = dict[int, _Photograph | CurviregError]
"""Photographs of a rig by their index, or why they failed."""


class _Rig:
    """Photographs of one object, whose poses are compared in all of them."""

    def __init__(self, registrar: "Registrar", photographs: Sequence[_Photograph]) -> None:
        self.registrar, self.describer, self.photographs = registrar, registrar.describer, photographs
        self.exact = registrar.is_exact(with_camera=True)
        symmetries = registrar.symmetries_of(exact=self.exact)
        self.symmetries = torch.eye(3)[None].double() if symmetries is None else symmetries[:, :3, :3].double()
        self.cameras = torch.stack([p.camera for p in photographs])

    @classmethod
    def of(cls, registrar: "Registrar", found: "_Found") -> "_Rig":
        """The photographs that were registered, if there are any, in the unit of the mesh."""
        photographs = [found[i] for i in sorted(found)]
        usable = [p for p in photographs if isinstance(p, _Photograph)]
        if not usable:
            errors = [one for one in photographs if isinstance(one, CurviregError)]
            reasons = "; ".join(f"image {i}: {error.message}" for i, error in enumerate(errors))
            raise InvalidInputError(f"no photograph can be registered: {reasons}")
        rig = cls(registrar, usable)
        rig.check_unit()
        return rig

    def check_unit(self) -> None:
        """Refuse cameras whose rays meet much nearer or farther than the size of the object says."""
        eyes, places = _camera_centres(self.cameras), self.places[0]
        distance = torch.linalg.vector_norm(places - eyes, dim=1)
        rays = (places - eyes) / distance[:, None]
        across = torch.eye(3).double() - rays[:, :, None] * rays[:, None]
        if float(torch.linalg.eigvalsh(across.mean(dim=0))[0]) < MIN_PARALLAX**2:
            return
        meeting = torch.linalg.solve(across.sum(dim=0), (across @ eyes[..., None]).sum(dim=0))[:, 0]
        factor = ((meeting - eyes) * rays).sum(dim=1).abs() / distance
        if float(factor.min()) > UNIT_FACTOR or float(factor.max()) < 1.0 / UNIT_FACTOR:
            raise InvalidInputError(
                f"T_cam_from_world: by its size the object is {float(distance[0]):.3g} away, by the cameras' rays "
                f"{float(factor[0] * distance[0]):.3g}; give translations in the mesh's unit",
                subject=f"image {self.photographs[0].index}",
            )

    @cached_property
    def places(self) -> tuple[Tensor, Tensor]:
        """(V, 3) places of the object's centre in the world, from each photograph alone, and covariances (V, 3, 3)."""
        return self.place_of(torch.stack([p.poses[0] for p in self.photographs]), torch.arange(len(self.photographs)))

    def place_of(self, T: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        """Centres (N, 3) of world poses, with covariances (N, 3, 3) of their estimates from photographs ``source``."""
        place = T[:, :3, :3] @ self.describer.centre + T[:, :3, 3]
        ray = place - _camera_centres(self.cameras)[source]
        distance = torch.linalg.vector_norm(ray, dim=1)
        along = ray / distance[:, None]
        outer = along[:, :, None] * along[:, None]
        across = (CENTRE_ERROR * self.describer.radius) ** 2 + (RIG_ERROR * distance) ** 2
        deep = (DEPTH_ERROR * distance) ** 2
        return place, across[:, None, None] * (torch.eye(3).double() - outer) + deep[:, None, None] * outer

    def candidates(self) -> Tensor:
        """(M, 4, 4) distinct world poses of all hypotheses, moved to where the photographs agree that the object is,
        most promising first."""
        T = torch.cat([p.poses for p in self.photographs])
        source = torch.arange(len(self.photographs)).repeat_interleave(
            torch.tensor([len(p.result.hypotheses) for p in self.photographs])
        )
        place, covariance = self.place_of(T, source)
        others, their_covariance = self.places
        gap = place[:, None] - others
        total = covariance[:, None] + their_covariance
        distance = (gap * torch.linalg.solve(total, gap)).sum(dim=-1)
        agree = (distance <= MAX_PLACE_DISTANCE).scatter(1, source[:, None], False)
        precision, theirs = torch.linalg.inv(covariance), torch.linalg.inv(their_covariance)
        sums = precision + (agree[:, :, None, None] * theirs).sum(dim=1)
        moved = (precision @ place[..., None])[..., 0]
        moved = moved + (agree[:, :, None] * (theirs @ others[..., None])[..., 0]).sum(dim=1)
        place = torch.linalg.solve(sums, moved)
        R = T[:, :3, :3]
        T = transform(R, place - R @ self.describer.centre)
        rank = torch.stack([self.rank(p, T) for p in self.photographs])
        order = _bounded(rank).sum(dim=0)
        return T[self.distinct(T, order)[:MAX_CANDIDATES]]

    def distinct(self, T: Tensor, score: Tensor) -> Tensor:
        """Indices of world poses, best first, without those that are nearly equal to a better one."""
        kept: list[int] = []
        place = T[:, :3, :3] @ self.describer.centre + T[:, :3, 3]
        for k in score.argsort(descending=True, stable=True).tolist():
            R = T[kept, None, :3, :3] @ self.symmetries
            near = _degrees((R * T[k, :3, :3]).sum(dim=(-2, -1)).amax(dim=1)) <= SAME_ANGLE
            shift = torch.linalg.vector_norm(place[kept] - place[k], dim=1)
            if not bool((near & (shift <= SAME_SHIFT * self.describer.radius)).any()):
                kept.append(k)
        return torch.tensor(kept)

    def rank(self, photograph: _Photograph, T: Tensor) -> Tensor:
        """(M,) log S of the best view of the bank near world poses, minus that of the best view of all."""
        ranking, bank = photograph.result.ranking, self.registrar.bank
        log = ranking.scores[0].cpu().double().clamp(min=torch.finfo(torch.float64).tiny).log()
        R, _ = self.allocentric(photograph, T)
        views = bank.rotations.cpu().double().flatten(1)
        angles = _degrees(((R[:, None] @ self.symmetries).flatten(2) @ views.T).amax(dim=1))
        near = angles <= torch.maximum(angles.amin(dim=1, keepdim=True), torch.tensor(NEAR_VIEW_ANGLE))
        return torch.where(near, log, -torch.inf).amax(dim=1) - log.max()

    def allocentric(self, photograph: _Photograph, T: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (M, 3, 3) as seen by a camera that looks straight at the object, and its distances (M,)."""
        T = photograph.camera @ T
        position = T[:, :3, :3] @ self.describer.centre + T[:, :3, 3]
        return rotation_towards(position).mT @ T[:, :3, :3], torch.linalg.vector_norm(position, dim=1)

    @cached_property
    def crops(self) -> tuple[Tensor, Tensor]:
        """(V, C, S, S) around the boxes, and (V, 1, S, S) 1 inside the photographs."""
        return torch.cat([p.crop for p in self.photographs]), torch.cat([p.inside for p in self.photographs])

    @cached_property
    def problem(self) -> RigProblem:
        """All photographs, of one pose."""
        photographs, settings = self.photographs, self.registrar.bank.settings
        crops, inside = self.crops
        squares = square_boxes(torch.stack([p.box for p in photographs]).float(), settings.margin)
        K = crop_transforms(squares, CROP_SIZE).double() @ torch.stack([p.K for p in photographs])
        masks = [p.mask for p in photographs if p.mask is not None]
        mask = ObjectMask(torch.cat(masks)) if masks else None
        index, group = torch.arange(len(photographs)), torch.zeros(len(photographs), dtype=torch.long)
        return RigProblem(
            self.describer.contours,
            EdgeField(crops, inside),
            index,
            K,
            CROP_SIZE,
            mask,
            axes=self.cameras[:, :3, :3],
            group=group,
        )

    def tied(self, problem: RigProblem, T: Tensor) -> tuple[RigProblem, Tensor]:
        """The problem of M world poses, and their poses (M V, 4, 4) in the cameras."""
        M, V = len(T), len(self.photographs)
        every = torch.arange(V).repeat(M)
        each = replace(problem[every], group=torch.arange(M).repeat_interleave(V))
        return each, self.cameras[every] @ T.repeat_interleave(V, dim=0)

    def fitted(self, problem: RigProblem, T: Tensor, radii: Sequence[float]) -> tuple[Tensor, Tensor, ContourState]:
        """World poses (M, 4, 4) after a joint fit, their edge supports (V, M), and their state.

        If the fit does not improve the support of all photographs together, the initial pose is kept.
        """
        each, cams = self.tied(problem, T)
        start = each.state(cams)
        found = each.descend(start, radii)
        V = len(self.photographs)
        (before, weighted_before), (after, weighted) = each.supports(start), each.supports(found)
        better = each.summed(weighted) > each.summed(weighted_before)
        state = ContourState.cat([start, found])[torch.arange(len(cams)) + len(cams) * better[each.group]]
        support = torch.where(better[each.group], after, before)
        first = state.T.view(len(T), V, 4, 4)[:, 0]
        return torch.linalg.inv(self.cameras[0]) @ first, support.view(len(T), V).T, state

    def answer(self) -> _Answer:
        """Candidates, fitted in all photographs and ordered by the sum of their scores; the hypotheses of one."""
        if len(self.photographs) == 1:
            return self.hypotheses_of_one()
        full, T = self.problem, self.candidates()
        half, quarter = (smaller_problem(full, *self.crops, factor) for factor in (2, 4))
        T, _, _ = self.fitted(quarter, T, QUARTER_SIZE_RADII)
        T, support, _ = self.fitted(half, T, FIRST_RADII)
        rank = torch.stack([self.rank(p, T) for p in self.photographs])
        promising = (SCORE_WEIGHTS[2] * support + _bounded(rank)).sum(dim=0)
        chosen = self.distinct(T, promising)
        T, support = T[chosen], support[:, chosen]
        best = min(FINISHED_CANDIDATES, len(T))
        finished, full_support, state = self.fitted(full, T[:best], FULL_SIZE_RADII)
        T, support = torch.cat([finished, T[best:]]), torch.cat([full_support, support[:, best:]], dim=1)
        covariance = torch.full((len(T), 6, 6), torch.nan, dtype=torch.float64)
        covariance[:best] = self.covariances(finished, state)
        evidence = torch.stack([self.evidence(p, T, support[v]) for v, p in enumerate(self.photographs)])
        sees = torch.stack([p.sees(self.describer.hull, T) for p in self.photographs])
        answer = _Answer(T, evidence, _bounded(self.scores(evidence), sees), sees, covariance)
        return answer[(self.weights(T[0]) @ answer.scores).argsort(descending=True, stable=True)]

    def hypotheses_of_one(self) -> _Answer:
        (photograph,) = self.photographs
        found = photograph.result.hypotheses
        evidence = torch.tensor([[h.evidence[name] for name in POSE_FEATURES] for h in found]).double()[None]
        P = torch.block_diag(*[photograph.camera[:3, :3]] * 2)
        none = torch.full((6, 6), torch.nan, dtype=torch.float64)
        C = torch.stack([none if h.covariance is None else P.mT @ h.covariance @ P for h in found])
        return _Answer(photograph.poses, evidence, self.scores(evidence), torch.ones(1, len(found)).bool(), C)

    def scores(self, evidence: Tensor) -> Tensor:
        """(V, M) of (V, M, 4)."""
        return evidence @ torch.tensor(SCORE_WEIGHTS if self.exact else RANK_ALONE, dtype=torch.float64)

    def hypothesis(self, answer: _Answer, m: int, evidence: Tensor) -> Hypothesis:
        """World pose ``m`` with its mean evidence, as it is reported."""
        first, T, C = self.photographs[0], answer.T[m], answer.covariance[m]
        (R,), (distance,) = self.allocentric(first, T[None])
        features = dict(zip(POSE_FEATURES, evidence.tolist(), strict=True))
        return Hypothesis(
            rotation=T[:3, :3].clone(),
            translation=T[:3, 3].clone(),
            score=features["similarity"],
            evidence=features,
            allocentric_rotation=R,
            distance=float(distance),
            projection=(first.camera @ T, first.K),
            view=nearest_view(self.registrar, R),
            edge_support=features["edge_support"],
            covariance=C.clone() if bool(C.isfinite().all()) else None,
        )

    def covariances(self, T: Tensor, state: ContourState) -> Tensor:
        """(M, 6, 6) of finished world poses."""
        each, _ = self.tied(self.problem, T)
        weights = torch.cat([self.weights(one) for one in T])
        arms = T[:, :3, :3] @ self.describer.centre
        away = torch.linalg.vector_norm((arms + T[:, :3, 3])[:, None] - _camera_centres(self.cameras), dim=-1)
        return each.information(state, weights).covariance(arms, away.amin(dim=1))[0]

    def weights(self, T: Tensor) -> Tensor:
        """(V,) in (0, 1] weights of photographs: those from nearly the same side of a world pose (4, 4) share one."""
        side = F.normalize(_camera_centres(self.cameras) - (T[:3, :3] @ self.describer.centre + T[:3, 3]), dim=1)
        angle = torch.rad2deg((side @ side.T).clamp(-1.0, 1.0).acos())
        return 1.0 / (1.0 - angle / SAME_DIRECTION).clamp(min=0.0).fill_diagonal_(1.0).sum(dim=1)

    def evidence(self, photograph: _Photograph, T: Tensor, support: Tensor) -> Tensor:
        """(M, 4) :data:`POSE_FEATURES` of world poses in a photograph."""
        R, distance = self.allocentric(photograph, T)
        views = F.normalize(self.describer.descriptors(R, distance), dim=1)
        similarity = (views @ photograph.descriptor[0]).double().cpu()
        appearance, ranking = torch.zeros_like(similarity), photograph.result.ranking
        if Appearance.name in ranking.terms:
            pictures, none = self.registrar.matcher.describer.shaded(R, distance), torch.zeros(len(T), dtype=torch.long)
            compared = (photograph.query, ranking, pictures, none)
            appearance = self.registrar.matcher.reranking_score(Appearance.name, *compared)
        return torch.stack([self.rank(photograph, T), similarity, support, appearance], dim=1)

    def lost(self, answer: _Answer) -> dict[int, str]:
        """Why photographs do not show the best pose, by their place in the rig; {} if none shows it."""
        reasons: dict[int, str] = {}
        values = [dict(zip(POSE_FEATURES, one, strict=True)) for one in answer.evidence[:, 0].tolist()]
        found = [refinement_confidence({n: one[n] for n in ("similarity", "edge_support")}) for one in values]
        for v, (sees, one) in enumerate(zip(answer.sees[:, 0].tolist(), values, strict=True)):
            if not sees:
                reasons[v] = ELSEWHERE
            elif found[v] < LOST_CONFIDENCE * max(found):
                numbers = f"edge support {one['edge_support']:.2f}, similarity {one['similarity']:.2f}"
                reasons[v] = f"the object is not seen where the other photographs have it ({numbers})"
        return reasons if len(reasons) < len(self.photographs) else {}


def _bounded(scores: Tensor, sees: Tensor | None = None) -> Tensor:
    """(V, M) scores, at least ``MAX_MARGIN`` below the best of each photograph; poses not seen get that least."""
    if sees is not None:
        scores = torch.where(sees, scores, -torch.inf)
    best = scores.amax(dim=1, keepdim=True)
    return torch.where(best.isfinite(), torch.maximum(scores, best - MAX_MARGIN), 0.0)


def _camera_centres(cameras: Tensor) -> Tensor:
    """(N, 3) in the world, of poses (N, 4, 4) of cameras."""
    return -(cameras[:, :3, :3].mT @ cameras[:, :3, 3:])[..., 0]


def _degrees(traces: Tensor) -> Tensor:
    """Angles of rotations with these traces."""
    return torch.rad2deg((0.5 * (traces - 1.0)).clamp(-1.0, 1.0).acos())


@torch.no_grad()
def register_views(
    registrar: "Registrar", images: Sequence[Any], boxes: Any, camera_matrices: Any, T_cam_from_world: Any
) -> Registration:
    """Register several photographs of one object together: one pose in the world.

    Each photograph is registered alone. The hypotheses of all become poses in the world, which are moved to where the
    photographs agree that the object is, fitted to the contours in all photographs at once, and ordered by the sum of
    their scores: a half turn that one photograph cannot see is decided by another. One photograph lowers a pose by at
    most five points, and those from nearly the same side share one vote. A photograph that does not show the best pose
    is left out, and the others decide again.

    Args:
        registrar: :class:`Registrar` of the mesh.
        images: V photographs, see :class:`Registrar`.
        boxes: (V, 4), or a list with None where there is no box: the poses that the others suggest say where the object
            is. None for no boxes at all: the object is searched for in each photograph.
        camera_matrices: (V, 3, 3) or (3, 3) in px.
        T_cam_from_world: (V, 4, 4) rigid poses of the cameras, with lengths in the mesh's unit.

    Returns:
        A registration whose poses are ``T_world_from_model``, whose covariance is along the world's axes, and whose
        ``views`` have the pose in each photograph. ``projection`` and ``ranking`` are those of the first photograph
        that counts. The covariance assumes that the poses of the cameras are right.

    Raises:
        InvalidInputError: no photograph can be registered; a camera's pose is not rigid; two photographs that differ
            come from the same place; or lengths of the cameras and of the mesh have different units.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=20, elevations=[10, 30])
        >>> registrar = cr.Registrar(cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False))
        >>> rig = torch.eye(4).double()[None]
        >>> result = registrar.register_views([scene.image], [scene.box], scene.camera_matrix, rig)
        >>> result.transform.shape, len(result.views)
        (torch.Size([4, 4]), 1)
    """
    cameras = _checked_cameras(T_cam_from_world, len(images))
    if camera_matrices is None:
        raise InvalidInputError("register_views: needs the camera matrix of each photograph")
    K = as_camera_matrices(camera_matrices, len(images))
    given = _given_boxes(boxes, len(images))
    items = image_items(images, [WHOLE_IMAGE if box is None else box for box in given], K)
    _check_places(items, cameras, K)
    missing = [i for i, box in enumerate(given) if box is None]
    if len(missing) == len(items):
        found = _detected(registrar, images, items, K, cameras)
    else:
        found = _registered(registrar, items, cameras, [i for i in range(len(items)) if i not in missing])
        if missing:
            where = _Rig.of(registrar, found).answer().T[:1]
            found |= _registered(registrar, items, cameras, missing, where)
    return _registration(registrar, found, cameras)


def _checked_cameras(poses: Any, count: int) -> Tensor:
    """(V, 4, 4) float64 rigid poses; errors name the photograph."""
    T = as_numbers(poses, "T_cam_from_world", dtype=torch.float64).detach().cpu().double()
    check_tensor(T, "T_cam_from_world", (count, 4, 4))
    for i, pose in enumerate(T):
        try:
            check_pose(pose, "T_cam_from_world")
        except InvalidInputError as error:
            raise error.with_subject(f"image {i}") from None
    return T


def _given_boxes(boxes: Any, count: int) -> list[list[float] | None]:
    """The box of each photograph, None where it is None or NaN."""
    given = [None] * count if boxes is None else [None if b is None else as_numbers(b, "boxes") for b in boxes]
    if len(given) != count or any(box is not None and box.shape != (4,) for box in given):
        raise InvalidInputError(f"boxes: expected {count} of four numbers, or None where there is no box, got {boxes}")
    return [None if box is None or bool(box.isnan().all()) else box.tolist() for box in given]


def _check_places(items: Sequence[ImageItem | CurviregError], cameras: Tensor, K: Tensor) -> None:
    """Refuse photographs that differ though they come from the same place."""
    poses = torch.cat([cameras.flatten(1), K.flatten(1).cpu().double()], dim=1)
    tolerance = 1e-9 * poses.abs().amax(dim=0)
    for i in range(1, len(items)):
        for j in ((poses[:i] - poses[i]).abs() <= tolerance).all(dim=1).nonzero()[:1, 0].tolist():
            one, other = items[j], items[i]
            if isinstance(one, ImageItem) and isinstance(other, ImageItem) and not _are_alike(one, other):
                raise InvalidInputError(
                    f"T_cam_from_world: the same as of image {j}, which shows something else; give each photograph "
                    "the pose of its own camera",
                    subject=f"image {i}",
                )


def _are_alike(one: ImageItem, other: ImageItem) -> bool:
    """Whether small copies of two photographs are correlated."""
    small = [F.adaptive_avg_pool2d(item.image.float().mean(dim=0)[None, None], 32).flatten() for item in (one, other)]
    a, b = (F.normalize((s - s.mean()).nan_to_num(), dim=0) for s in small)
    return one.size == other.size and float(a @ b) >= SAME_PICTURE


def _registered(
    registrar: "Registrar",
    items: Sequence[ImageItem | CurviregError],
    cameras: Tensor,
    chosen: Sequence[int],
    T: Tensor | None = None,
) -> _Found:
    """Some photographs registered alone: in their boxes, or in those around a world pose ``T`` (1, 4, 4)."""

    def item(k: int) -> ImageItem | CurviregError:
        one = items[chosen[k]]
        if T is None or not isinstance(one, ImageItem):
            return one
        assert one.camera_matrix is not None
        hull, K = registrar.describer.hull, one.camera_matrix.double()
        box, visible = boxes_at(hull, cameras[chosen[k]] @ T, K, one.size)
        return replace(one, box=box[0].float()) if bool(visible) else LostObjectError(ELSEWHERE)

    def register(one: ImageItem, k: int) -> _Photograph:
        return _Photograph.of(registrar, one, registrar.register_item(one), chosen[k], cameras[chosen[k]])

    found = registrar.map_items(OnDemand(item, len(chosen)), register)
    return {i: r.error if isinstance(r, FailedRegistration) else r for i, r in zip(chosen, found, strict=True)}


def _detected(
    registrar: "Registrar",
    images: Sequence[Any],
    items: Sequence[ImageItem | CurviregError],
    K: Tensor,
    cameras: Tensor,
) -> _Found:
    """Photographs in which the object was searched for, each alone."""
    found: _Found = {}
    for i, (result,) in enumerate(detect(registrar, images, K)):
        if isinstance(result, FailedRegistration):
            found[i] = result.error
        else:
            item = items[i]
            assert isinstance(item, ImageItem)
            assert result.detection is not None
            item = replace(item, box=result.detection.box.float())
            found[i] = _Photograph.of(registrar, item, result, i, cameras[i])
    return found


def _registration(registrar: "Registrar", found: _Found, cameras: Tensor) -> Registration:
    """The joint result of photographs, without those that failed or do not show the best pose."""
    reasons = {i: one.message for i, one in found.items() if not isinstance(one, _Photograph)}
    rig = _Rig.of(registrar, found)
    answer = rig.answer()
    compared = {p.index: answer.evidence[v, 0] for v, p in enumerate(rig.photographs)}
    if lost := rig.lost(answer):
        reasons |= {rig.photographs[v].index: reason for v, reason in lost.items()}
        rig = _Rig(registrar, [p for v, p in enumerate(rig.photographs) if v not in lost])
        answer = rig.answer()
        compared |= {p.index: answer.evidence[v, 0] for v, p in enumerate(rig.photographs)}
    first, weights = rig.photographs[0], rig.weights(answer.T[0])
    total, mean = weights @ answer.scores, torch.einsum("v,vmk->mk", weights / weights.sum(), answer.evidence)
    shares = [p.result.confidence_features["concentration"] for p in rig.photographs]
    known = [torch.nan if share is None else share for share in shares]
    share = float(weights @ torch.tensor(known).double() / weights.sum())
    features = confidence_features(mean, total, None if math.isnan(share) else share)
    count = registrar.pipeline.hypotheses
    probabilities: tuple[float, ...] = first.result.probabilities
    if len(rig.photographs) > 1 and is_calibrated(registrar.pipeline):
        confidence = registration_confidence(features, exact=rig.exact)
        probabilities = hypothesis_probabilities(confidence, total, exact=rig.exact)[:count]
    margins = weights * (answer.scores[:, 0] - answer.scores[:, 1:2].sum(dim=1)) if len(total) > 1 else 0.0 * weights
    contributions = dict(zip([p.index for p in rig.photographs], margins.tolist(), strict=True))
    views = []
    for i, camera in enumerate(cameras):
        one, values = found[i], compared.get(i)
        view = PhotographPose(camera @ answer.T[0], failure=reasons.get(i), contribution=contributions.get(i, 0.0))
        if isinstance(one, _Photograph) and values is not None:
            view = replace(view, box=one.box, similarity=float(values[1]), edge_support=float(values[2]))
        views.append(view)
    every = [set(p.result.warnings) for p in rig.photographs]
    return Registration(
        hypotheses=tuple(rig.hypothesis(answer, m, mean[m]) for m in range(min(count, len(total)))),
        probabilities=probabilities,
        ranking=first.result.ranking,
        confidence_features=features,
        warnings=tuple(sorted(set.intersection(*every))),
        views=tuple(views),
    )
