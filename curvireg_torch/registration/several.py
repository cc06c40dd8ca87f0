"""One pose from several photographs: candidates of each are compared, and fitted to contours, in all of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CurviregError, InvalidInputError, LostObjectError
from ..filters.inputs import fill_missing
from ..geometry.cameras import rotation_towards, transform
from ..geometry.crops import box_iou, crop_transforms, square_boxes
from ..terms import Appearance, QueryFeatures, crop_regions
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
from .inputs import ImageItem, OnDemand, image_items, is_missing, rig_cameras
from .least_squares import Information, pose_information
from .localization import localize
from .poses import POSE_FEATURES, RANK_ALONE, SCORE_WEIGHTS
from .refinement import LOST_CONFIDENCE, nearest_view
from .result import FailedRegistration, Hypothesis, PhotographPose, Registration
from .tracker import boxes_at

if TYPE_CHECKING:
    from .registrar import Registrar

__all__ = ["register_views"]

FITTED_CANDIDATES, JUDGED_CANDIDATES, FINISHED_CANDIDATES = 6, 4, 2
"""World poses that are fitted in all photographs, those whose evidence is compared, and those fitted at full size."""

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
"""Degrees within which two photographs show partly the same; the weights of equal ones add up to one."""

MIN_PARALLAX, MAX_UNIT_FACTOR = 0.03, 30.0
"""Root mean square sine of the angles between rays from which they tell a distance, and the factor between that and the
distance from the object's size that is a mistake in the unit."""

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

    def summed(self, x: Tensor) -> Tensor:
        """(G, ...) sums of (N, ...) over the photographs of each pose."""
        return x.new_zeros(int(self.group.max()) + 1, *x.shape[1:]).index_add(0, self.group, x)

    def solution(self, A: Tensor, b: Tensor) -> Tensor:
        P = self.frames
        shared = super().solution(self.summed(P.mT @ A @ P), self.summed(P.mT @ b))
        return (P @ shared[self.group, :, None])[..., 0]

    def step_fraction(self, step: Tensor, T: Tensor) -> Tensor:
        least = T.new_ones(int(self.group.max()) + 1)
        return least.scatter_reduce(0, self.group, super().step_fraction(step, T), "amin")[self.group]

    def information(self, state: ContourState, weights: Tensor) -> Information:
        """What the edges of all photographs, with weights (N,), tell of each pose, along the world's axes."""
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

    @staticmethod
    def of(registrar: "Registrar", item: ImageItem, result: Registration, index: int, camera: Tensor) -> "_Photograph":
        box = item.box.double() if result.corrected_box is None else result.corrected_box
        settings, boxes, image = registrar.bank.settings, box.float()[None], item.image.expand(3, -1, -1)
        assert item.camera_matrix is not None

        def crop(size: int) -> Tensor:
            return crop_regions([image], boxes[:, None], size=size, margin=settings.margin)[:, 0].float()

        query = registrar.matcher.features(crop(settings.image_size).to(registrar.bank.device))
        return _Photograph(
            index=index,
            camera=camera,
            K=item.camera_matrix.double(),
            size=item.size,
            box=box,
            crop=fill_missing(crop(CROP_SIZE)),
            inside=inside_photographs([image], boxes, CROP_SIZE, settings.margin),
            query=query,
            descriptor=F.normalize(registrar.describer.descriptor(query.field), dim=1)[0],
            mask=registrar.object_mask(query, [replace(item, box=boxes[0])]),
            result=result,
        )

    @property
    def poses(self) -> Tensor:
        """(H, 4, 4) ``T_world_from_model`` of its hypotheses."""
        poses: Tensor = torch.linalg.inv(self.camera) @ torch.stack([h.projection[0] for h in self.result.hypotheses])
        return poses

    def sees(self, hull: Tensor, T: Tensor) -> Tensor:
        """(N,) bool: whether world poses (N, 4, 4) lie near the box."""
        boxes, visible = boxes_at(hull, self.camera @ T, self.K, self.size)
        return visible & (box_iou(boxes, self.box[None].to(boxes))[:, 0] >= MIN_OVERLAP)


_Found = dict[int, _Photograph | CurviregError]
"""Photographs of a rig by their index, or why they failed."""


@dataclass(frozen=True)
class _Answer:
    """M candidate poses in the world, best first, with ``evidence`` (V, M, 4) and ``scores`` (V, M) in V photographs,
    and covariances (M, 6, 6), NaN for those that are not finished."""

    T: Tensor
    evidence: Tensor
    scores: Tensor
    covariance: Tensor


class _Rig:
    """Photographs of one object, whose poses are compared in all of them."""

    def __init__(self, registrar: "Registrar", photographs: Sequence[_Photograph]) -> None:
        self.registrar, self.describer, self.photographs = registrar, registrar.describer, photographs
        self.exact = registrar.is_exact(with_camera=True)
        symmetries = registrar.symmetries_of(exact=self.exact)
        self.symmetries = torch.eye(3)[None].double() if symmetries is None else symmetries[:, :3, :3].double()
        self.cameras = torch.stack([p.camera for p in photographs])
        self.eyes = -(self.cameras[:, :3, :3].mT @ self.cameras[:, :3, 3:])[..., 0]

    @staticmethod
    def of(registrar: "Registrar", found: _Found) -> "_Rig":
        """The photographs that were registered, if there are any, in the unit of the mesh."""
        usable = [one for _, one in sorted(found.items()) if isinstance(one, _Photograph)]
        if not usable:
            reasons = "; ".join(
                f"image {i}: {one.message}" for i, one in found.items() if isinstance(one, CurviregError)
            )
            raise InvalidInputError(f"no photograph can be registered: {reasons}")
        rig = _Rig(registrar, usable)
        rig.check_unit()
        return rig

    def check_unit(self) -> None:
        """Refuse cameras whose rays meet much nearer or farther than the size of the object says."""
        rays = self.places[0] - self.eyes
        distance = torch.linalg.vector_norm(rays, dim=1)
        rays = rays / distance[:, None]
        across = torch.eye(3).double() - rays[:, :, None] * rays[:, None]
        if float(torch.linalg.eigvalsh(across.mean(dim=0))[0]) < MIN_PARALLAX**2:
            return
        meeting = torch.linalg.solve(across.sum(dim=0), (across @ self.eyes[..., None]).sum(dim=0))[:, 0]
        factor = ((meeting - self.eyes) * rays).sum(dim=1).abs() / distance
        if float(factor.min()) > MAX_UNIT_FACTOR or float(factor.max()) < 1.0 / MAX_UNIT_FACTOR:
            raise InvalidInputError(
                f"T_cam_from_world: by its size the object is {float(distance[0]):.3g} away, by the cameras' rays "
                f"{float(factor[0] * distance[0]):.3g}; give translations in the mesh's unit",
                subject=f"image {self.photographs[0].index}",
            )

    def centres(self, T: Tensor) -> Tensor:
        """(N, 3) the object's centres of poses (N, 4, 4)."""
        centres: Tensor = T[:, :3, :3] @ self.describer.centre + T[:, :3, 3]
        return centres

    @cached_property
    def places(self) -> tuple[Tensor, Tensor]:
        """The object's centre (V, 3) from each photograph alone, and its precision, see :meth:`precision`."""
        place = self.centres(torch.stack([p.poses[0] for p in self.photographs]))
        return place, self.precision(place, torch.arange(len(place)))

    def precision(self, place: Tensor, source: Tensor) -> Tensor:
        """(N, 3, 3) inverse covariances of centres (N, 3) that photographs ``source`` (N,) alone tell."""
        ray = place - self.eyes[source]
        distance = torch.linalg.vector_norm(ray, dim=1)[:, None, None]
        along = (ray[:, :, None] * ray[:, None]) / distance**2
        across = (CENTRE_ERROR * self.describer.radius) ** 2 + (RIG_ERROR * distance) ** 2
        precision: Tensor = (torch.eye(3).double() - along) / across + along / (DEPTH_ERROR * distance) ** 2
        return precision

    def candidates(self) -> Tensor:
        """(M, 4, 4) distinct world poses of all hypotheses, moved to where the photographs agree that the object is,
        most promising first."""
        T = torch.cat([p.poses for p in self.photographs])
        source = torch.tensor([v for v, p in enumerate(self.photographs) for _ in p.result.hypotheses])
        place, (others, theirs) = self.centres(T), self.places
        own = self.precision(place, source)
        gap = (place[:, None] - others)[..., None]
        total = torch.linalg.inv(own)[:, None] + torch.linalg.inv(theirs)
        agree = (gap.mT @ torch.linalg.solve(total, gap))[..., 0, 0] <= MAX_PLACE_DISTANCE
        agree = agree.scatter(1, source[:, None], False)[:, :, None, None].double()
        A = own + (agree * theirs).sum(dim=1)
        b = own @ place[..., None] + (agree * (theirs @ others[..., None])).sum(dim=1)
        R = T[:, :3, :3]
        T = transform(R, torch.linalg.solve(A, b)[..., 0] - R @ self.describer.centre)
        return T[self.distinct(T, _bounded(self.ranks(T)).sum(dim=0))[:FITTED_CANDIDATES]]

    def distinct(self, T: Tensor, score: Tensor) -> Tensor:
        """Indices of world poses, best first, without those that are nearly equal to a better one."""
        kept: list[int] = []
        place = self.centres(T)
        for k in score.argsort(descending=True, stable=True).tolist():
            near = self.angles(T[kept, :3, :3], T[k : k + 1, :3, :3])[:, 0] <= SAME_ANGLE
            shift = torch.linalg.vector_norm(place[kept] - place[k], dim=1)
            if not bool((near & (shift <= SAME_SHIFT * self.describer.radius)).any()):
                kept.append(k)
        return torch.tensor(kept)

    def angles(self, R: Tensor, others: Tensor) -> Tensor:
        """(M, N) degrees between rotations (M, 3, 3) and (N, 3, 3), up to symmetries."""
        traces = ((R[:, None] @ self.symmetries).flatten(2) @ others.flatten(1).T).amax(dim=1)
        return torch.rad2deg((0.5 * (traces - 1.0)).clamp(-1.0, 1.0).acos())

    def ranks(self, T: Tensor) -> Tensor:
        """(V, M) log S of the best view of the bank near world poses, minus that of the best view of all."""
        ranks, views = [], self.registrar.bank.rotations.cpu().double()
        for photograph in self.photographs:
            scores = photograph.result.ranking.scores[0].cpu().double()
            log = scores.clamp(min=torch.finfo(torch.float64).tiny).log()
            angles = self.angles(self.allocentric(photograph, T)[0], views)
            near = angles <= angles.amin(dim=1, keepdim=True).clamp(min=NEAR_VIEW_ANGLE)
            ranks.append(torch.where(near, log, -torch.inf).amax(dim=1) - log.max())
        return torch.stack(ranks)

    def allocentric(self, photograph: _Photograph, T: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (M, 3, 3) as seen by a camera that looks straight at the object, and its distances (M,)."""
        position = self.centres(photograph.camera @ T)
        R = rotation_towards(position).mT @ photograph.camera[:3, :3] @ T[:, :3, :3]
        return R, torch.linalg.vector_norm(position, dim=1)

    @cached_property
    def problems(self) -> list[RigProblem]:
        """One pose in all photographs: at full size, half of it, and a quarter."""
        photographs, settings = self.photographs, self.registrar.bank.settings
        crops, inside = (torch.cat([getattr(p, name) for p in photographs]) for name in ("crop", "inside"))
        squares = square_boxes(torch.stack([p.box for p in photographs]).float(), settings.margin)
        K = crop_transforms(squares, CROP_SIZE).double() @ torch.stack([p.K for p in photographs])
        masks = [p.mask for p in photographs if p.mask is not None]
        mask = ObjectMask(torch.cat(masks)) if masks else None
        index = torch.arange(len(photographs))
        tied = {"axes": self.cameras[:, :3, :3], "group": torch.zeros_like(index)}
        full = RigProblem(self.describer.contours, EdgeField(crops, inside), index, K, CROP_SIZE, mask, 1.0, **tied)
        return [full, *(smaller_problem(full, crops, inside, factor) for factor in (2, 4))]

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
        (each, cams), V = self.tied(problem, T), len(self.photographs)
        start = each.state(cams)
        found = each.descend(start, radii)
        (before, weighted_before), (after, weighted) = each.supports(start), each.supports(found)
        better = (each.summed(weighted) > each.summed(weighted_before))[each.group]
        state = ContourState.cat([start, found])[torch.arange(len(cams)) + len(cams) * better]
        support = torch.where(better, after, before).view(len(T), V).T
        return torch.linalg.inv(self.cameras[0]) @ state.T[::V], support, state

    def answer(self) -> _Answer:
        """Candidates, fitted in all photographs and ordered by the sum of their scores; the hypotheses of one."""
        if len(self.photographs) == 1:
            return self.hypotheses_of_one()
        full, half, quarter = self.problems
        T, _, _ = self.fitted(quarter, self.candidates(), QUARTER_SIZE_RADII)
        T, support, _ = self.fitted(half, T, FIRST_RADII)
        promising = (SCORE_WEIGHTS[2] * support + _bounded(self.ranks(T))).sum(dim=0)
        chosen = self.distinct(T, promising)[:JUDGED_CANDIDATES]
        T, support = T[chosen], support[:, chosen]
        best = min(FINISHED_CANDIDATES, len(T))
        T[:best], support[:, :best], state = self.fitted(full, T[:best], FULL_SIZE_RADII)
        covariance = torch.full((len(T), 6, 6), torch.nan, dtype=torch.float64)
        covariance[:best] = self.covariances(T[:best], state)
        evidence = self.evidence(T, support)
        sees = torch.stack([p.sees(self.describer.hull, T) for p in self.photographs])
        scores = _bounded(torch.where(sees, self.scores(evidence), -torch.inf))
        order = (self.weights(T[0]) @ scores).argsort(descending=True, stable=True)
        return _Answer(T[order], evidence[:, order], scores[:, order], covariance[order])

    def hypotheses_of_one(self) -> _Answer:
        (photograph,) = self.photographs
        found = photograph.result.hypotheses
        evidence = torch.tensor([[h.evidence[name] for name in POSE_FEATURES] for h in found]).double()[None]
        P, unknown = torch.block_diag(*[self.cameras[0, :3, :3]] * 2), torch.full((6, 6), torch.nan).double()
        C = torch.stack([unknown if h.covariance is None else h.covariance for h in found])
        return _Answer(photograph.poses, evidence, self.scores(evidence), P.mT @ C @ P)

    def covariances(self, T: Tensor, state: ContourState) -> Tensor:
        """(M, 6, 6) of finished world poses."""
        each, _ = self.tied(self.problems[0], T)
        weights = torch.cat([self.weights(one) for one in T])
        distance = torch.linalg.vector_norm(self.centres(T)[:, None] - self.eyes, dim=-1).amin(dim=1)
        return each.information(state, weights).covariance(T[:, :3, :3] @ self.describer.centre, distance)[0]

    def weights(self, T: Tensor) -> Tensor:
        """(V,) in (0, 1] weights of photographs: those from nearly the same side of a world pose (4, 4) share one."""
        side = F.normalize(self.eyes - self.centres(T[None]), dim=1)
        angle = torch.rad2deg((side @ side.T).clamp(-1.0, 1.0).acos())
        return 1.0 / (1.0 - angle / SAME_DIRECTION).clamp(min=0.0).fill_diagonal_(1.0).sum(dim=1)

    def evidence(self, T: Tensor, support: Tensor) -> Tensor:
        """(V, M, 4) :data:`POSE_FEATURES` of world poses with edge supports (V, M)."""
        matcher, parts = self.registrar.matcher, []
        for photograph in self.photographs:
            R, distance = self.allocentric(photograph, T)
            views = F.normalize(self.describer.descriptors(R, distance), dim=1)
            similarity = (views @ photograph.descriptor).double().cpu()
            appearance, ranking = torch.zeros_like(similarity), photograph.result.ranking
            if Appearance.name in ranking.terms:
                compared = (
                    photograph.query,
                    ranking,
                    matcher.describer.shaded(R, distance),
                    torch.zeros(len(T)).long(),
                )
                appearance = matcher.reranking_score(Appearance.name, *compared)
            parts.append(torch.stack([similarity, appearance]))
        similarity, appearance = torch.stack(parts, dim=1)
        return torch.stack([self.ranks(T), similarity, support, appearance], dim=-1)

    def scores(self, evidence: Tensor) -> Tensor:
        """(V, M) of (V, M, 4)."""
        return evidence @ torch.tensor(SCORE_WEIGHTS if self.exact else RANK_ALONE, dtype=torch.float64)

    def lost(self, answer: _Answer) -> dict[int, str]:
        """Why photographs do not show the best pose, by their index; {} if none shows it."""
        reasons: dict[int, str] = {}
        pairs = answer.evidence[:, 0, 1:3].tolist()
        found = [refinement_confidence({"similarity": one, "edge_support": other}) for one, other in pairs]
        for photograph, confidence, (similarity, support) in zip(self.photographs, found, pairs, strict=True):
            if not bool(photograph.sees(self.describer.hull, answer.T[:1])):
                reasons[photograph.index] = ELSEWHERE
            elif confidence < LOST_CONFIDENCE * max(found):
                numbers = f"edge support {support:.2f}, similarity {similarity:.2f}"
                reasons[photograph.index] = f"the object is not seen where the other photographs have it ({numbers})"
        return reasons if len(reasons) < len(self.photographs) else {}

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


def _bounded(scores: Tensor) -> Tensor:
    """(V, M) scores, at least ``MAX_MARGIN`` below the best of each photograph."""
    best = scores.amax(dim=1, keepdim=True)
    return torch.where(best.isfinite(), torch.maximum(scores, best - MAX_MARGIN), 0.0)


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
        camera_matrices: see :class:`Registrar`; needed.
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
    if camera_matrices is None:
        raise InvalidInputError("register_views: needs the camera matrix of each photograph")
    items = image_items(images, boxes, camera_matrices)
    cameras = rig_cameras(T_cam_from_world, items)
    given = [] if boxes is None else [i for i, box in enumerate(boxes) if not is_missing(box)]
    found: _Found = {}
    if given:
        found = _registered(registrar, items, cameras, given)
    else:
        for i, (result,) in enumerate(localize(registrar, images, camera_matrices)):
            found[i] = _found(registrar, items[i], result, i, cameras[i])
    if missing := [i for i in range(len(items)) if i not in found]:
        where = _Rig.of(registrar, found).answer().T[:1]
        found |= _registered(registrar, items, cameras, missing, where)
    return _registration(registrar, found, cameras)


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
        pose, K = cameras[chosen[k]] @ T, one.camera_matrix.double()
        box, visible = boxes_at(registrar.describer.hull, pose, K, one.size)
        return replace(one, box=box[0].float()) if bool(visible) else LostObjectError(ELSEWHERE)

    def register(some: Sequence[ImageItem | CurviregError], first: int) -> list[_Photograph | CurviregError]:
        results = registrar.register_items(some, first)
        each = zip(some, results, chosen[first : first + len(some)], strict=True)
        return [_found(registrar, one, result, i, cameras[i]) for one, result, i in each]

    return dict(zip(chosen, registrar.map_items(OnDemand(item, len(chosen)), register), strict=True))


def _found(
    registrar: "Registrar",
    item: ImageItem | CurviregError,
    result: Registration | FailedRegistration,
    index: int,
    camera: Tensor,
) -> _Photograph | CurviregError:
    if isinstance(result, FailedRegistration):
        return result.error
    assert isinstance(item, ImageItem)
    if result.localization is not None:
        item = replace(item, box=result.localization.box.float())
    return _Photograph.of(registrar, item, result, index, camera)


def _registration(registrar: "Registrar", found: _Found, cameras: Tensor) -> Registration:
    """The joint result of photographs, without those that failed or do not show the best pose."""
    reasons = {i: one.message for i, one in found.items() if isinstance(one, CurviregError)}
    rig = _Rig.of(registrar, found)
    answer = rig.answer()
    compared = dict(zip([p.index for p in rig.photographs], answer.evidence[:, 0], strict=True))
    if lost := rig.lost(answer):
        reasons |= lost
        rig = _Rig(registrar, [p for p in rig.photographs if p.index not in lost])
        answer = rig.answer()
        compared |= dict(zip([p.index for p in rig.photographs], answer.evidence[:, 0], strict=True))
    first, weights = rig.photographs[0], rig.weights(answer.T[0])
    total, mean = weights @ answer.scores, torch.einsum("v,vmk->mk", weights / weights.sum(), answer.evidence)
    shares = [p.result.confidence_features["concentration"] for p in rig.photographs]
    known = torch.tensor([torch.nan if share is None else share for share in shares]).double()
    features = confidence_features(mean, total, float(weights @ known / weights.sum()))
    count = registrar.pipeline.hypotheses
    probabilities: tuple[float, ...] = first.result.probabilities
    if len(rig.photographs) > 1 and is_calibrated(registrar.pipeline):
        confidence = registration_confidence(features, exact=rig.exact)
        probabilities = hypothesis_probabilities(confidence, total, exact=rig.exact)[:count]
    margins = weights * (answer.scores[:, 0] - answer.scores[:, min(1, len(total) - 1)])
    contributions = dict(zip([p.index for p in rig.photographs], margins.tolist(), strict=True))
    views = []
    for i, camera in enumerate(cameras):
        view = PhotographPose(camera @ answer.T[0], failure=reasons.get(i), contribution=contributions.get(i, 0.0))
        if isinstance(one := found[i], _Photograph):
            _, similarity, support, _ = compared[i].tolist()
            view = replace(view, box=one.box, similarity=similarity, edge_support=support)
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
