"""Photographs of one object by cameras with known poses: world poses are fitted and compared in all
of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import CurviregError, InvalidInputError
from ..evidence import Evidence
from ..fitting.contour_fit import FIRST_RADII, QUARTER_SIZE_RADII
from ..fitting.contour_problem import ContourProblem, ContourState
from ..fitting.details import compare_details
from ..fitting.edges import CROP_SIZE, EdgeCrops
from ..fitting.least_squares import Measurements, pose_covariance
from ..fitting.measured_fit import FULL_SIZE_RADII
from ..geometry import rotation_error
from ..geometry.cameras import point_in_cameras, pose_around, rotation_towards
from ..geometry.conversions import axis_angle_from_rotation, cross_matrix
from ..geometry.crops import box_iou
from ..geometry.framing import boxes_at
from ..geometry.viewpoint import angles_between
from ..rendering.contours import ContourPoints
from ..terms import crop_photographs
from .block import Described, described, evidence_of
from .confidence import MAX_MARGIN, refinement_confidence
from .hypotheses import Hypotheses
from .photograph import Photograph
from .result import Hypothesis, Registration
from .target import Target, nearest_view

# World poses that are fitted in all photographs, those whose evidence is compared, and those fitted
# at full size
FITTED_CANDIDATES = 6
JUDGED_CANDIDATES = 4
FINISHED_CANDIDATES = 2
# Weight of the edge support, beside log S, in the choice of the candidates that are compared
SUPPORT_WEIGHT = 10.0
# Degrees, and shift in object radii, within which two candidates count as one; the best view of the
# bank so near to a pose stands for it
SAME_ANGLE = 15.0
SAME_SHIFT = 0.5
# Standard deviations of an object's place from one photograph: along its ray and across it, as
# fractions of the distance, and across it in object radii
DEPTH_ERROR = 0.08
RIG_ERROR = 0.01
CENTRE_ERROR = 0.1
# Squared Mahalanobis distance up to which two photographs see the object in the same place
MAX_PLACE_DISTANCE = 16.0
MIN_OVERLAP = 0.3  # Overlap (IoU) with the box of a photograph below which a pose lies elsewhere
# Degrees within which two photographs show partly the same; the weights of equal ones add up to one
SAME_DIRECTION = 30.0
# Root mean square sine of the angles between rays from which they tell a distance, and the factor
# between that and the distance from the object's size that is a mistake in the unit
MIN_PARALLAX = 0.03
MAX_UNIT_FACTOR = 30.0
ELSEWHERE = "where the other photographs have the object, it lies outside this one or its box"


@dataclass(frozen=True, kw_only=True)
class RigProblem(ContourProblem):
    """Poses of several photographs: those with the same number in ``group`` (N,) are one pose in
    the world, seen by cameras with ``axes`` (N, 3, 3), rotations from the axes of the first camera:
    the result does not depend on those of the world. Each photograph alone found ``alone`` (N, 4,
    4), with a precision whose root is ``root`` (N, 6, 6): it may know more than its contours tell,
    such as the rotation of a can by its label."""

    axes: Tensor
    group: Tensor
    alone: Tensor
    root: Tensor

    def step(
        self, points: ContourPoints, T: Tensor, radius: float, others: Sequence[Measurements] = ()
    ) -> Tensor:
        scale = self.size / CROP_SIZE
        distance = self.gaps(T)
        known = Measurements(scale * self.root, scale * distance, torch.ones_like(distance))
        return super().step(points, T, radius, [*others, known])

    def gaps(self, T: Tensor) -> Tensor:
        """(N, 6, 1) from poses to those that the photographs alone found, in standard deviations of
        these."""
        turn = axis_angle_from_rotation(self.alone[:, :3, :3] @ T[:, :3, :3].mT)
        shift = point_in_cameras(self.alone - T, self.centre)
        return self.root @ torch.cat([turn, shift], dim=1)[..., None]

    def solution(self, A: Tensor, b: Tensor) -> Tensor:
        P = in_frames(self.axes)
        shared = super().solution(self.summed(P.mT @ A @ P), self.summed(P.mT @ b))
        return (P @ shared[self.group, :, None])[..., 0]

    def step_fraction(self, step: Tensor, T: Tensor) -> Tensor:
        least = T.new_ones(int(self.group.max()) + 1)
        return least.scatter_reduce(0, self.group, super().step_fraction(step, T), "amin")[
            self.group
        ]

    def summed(self, x: Tensor) -> Tensor:
        """(G, ...) sums of (N, ...) over the photographs of each pose."""
        return x.new_zeros(int(self.group.max()) + 1, *x.shape[1:]).index_add(0, self.group, x)


def in_frames(axes: Tensor) -> Tensor:
    """(N, 6, 6) from twists along some axes to those along other ones, of rotations (N, 3, 3)."""
    return torch.kron(torch.eye(2, dtype=axes.dtype), axes)


@dataclass(frozen=True, kw_only=True)
class RigPhotograph(Described):
    """A registered photograph.

    Attributes:
        index: of it among those that were given.
        camera: (4, 4) from the world.
        photograph: with the box in which poses are compared.
        result: the registration of it alone.
    """

    crops: EdgeCrops
    index: int
    camera: Tensor
    photograph: Photograph
    result: Registration

    @staticmethod
    def of(
        target: Target, item: Photograph, result: Registration, index: int, camera: Tensor
    ) -> "RigPhotograph":
        box = item.box.double() if result.corrected_box is None else result.corrected_box
        settings = target.bank.settings
        item = replace(item, image=item.image.expand(3, -1, -1), box=box)
        crop = crop_photographs(
            [item.image], box.float()[None], size=settings.image_size, margin=settings.margin
        ).float()
        query = target.matcher.features(crop.to(target.bank.device))
        seen = described(target, [item], query, [result.ranking], contours=True)
        return RigPhotograph(
            **vars(seen), index=index, camera=camera, photograph=item, result=result
        )

    @property
    def poses(self) -> Tensor:
        """(H, 4, 4) ``T_world_from_model`` of its hypotheses."""
        poses: Tensor = torch.linalg.inv(self.camera) @ torch.stack(
            [h.projection[0] for h in self.result.hypotheses]
        )
        return poses

    def sees(self, hull: Tensor, T: Tensor) -> Tensor:
        """(N,) bool: whether world poses (N, 4, 4) lie near the box."""
        seen = self.photograph
        boxes, visible = boxes_at(hull, self.camera @ T, seen.K, seen.size)
        return visible & (box_iou(boxes, seen.box[None].to(boxes))[:, 0] >= MIN_OVERLAP)


# Photographs of a rig by their index, or why they failed
RigPhotographs = dict[int, RigPhotograph | CurviregError]


@dataclass(frozen=True)
class JointPoses:
    """M candidate poses in the world, best first, with evidence and scores, each (V, M), in V
    photographs, and covariances (M, 6, 6), NaN where unfinished."""

    T: Tensor
    evidence: Evidence
    scores: Tensor
    covariance: Tensor


class Rig:
    """Photographs of one object, whose poses are compared in all of them."""

    def __init__(self, target: Target, photographs: Sequence[RigPhotograph]) -> None:
        self.target = target
        self.describer = target.describer
        self.photographs = photographs
        self.exact = target.is_exact
        self.score_weights = target.score_weights(exact=self.exact)
        # the ranking does not see small features
        self.symmetries = _rotations(target.symmetries_of(exact=self.exact))
        self.feature_is_hidden = all(p.result.feature_is_hidden for p in photographs)
        self.answer_symmetries = _rotations(
            target.symmetries_of_answers(feature_is_hidden=self.feature_is_hidden)
        )
        self.cameras = torch.stack([p.camera for p in photographs])
        self.eyes = -(self.cameras[:, :3, :3].mT @ self.cameras[:, :3, 3:])[..., 0]

    @staticmethod
    def of(target: Target, found: RigPhotographs) -> "Rig":
        """The photographs that were registered, if there are any, in the unit of the mesh."""
        usable = [one for _, one in sorted(found.items()) if isinstance(one, RigPhotograph)]
        if not usable:
            causes = [
                one.with_subject("").of_image(i)
                for i, one in found.items()
                if isinstance(one, CurviregError)
            ]
            raise InvalidInputError("no photograph can be registered", causes=causes)
        rig = Rig(target, usable)
        rig.check_unit()
        return rig

    def check_unit(self) -> None:
        """Refuse cameras whose rays meet much nearer or farther than the size of the object
        says."""
        rays = self.places[0] - self.eyes
        distance = torch.linalg.vector_norm(rays, dim=1)
        rays = rays / distance[:, None]
        across = torch.eye(3).double() - rays[:, :, None] * rays[:, None]
        if float(torch.linalg.eigvalsh(across.mean(dim=0))[0]) < MIN_PARALLAX**2:
            return
        meeting = torch.linalg.solve(across.sum(dim=0), (across @ self.eyes[..., None]).sum(dim=0))[
            :, 0
        ]
        factor = ((meeting - self.eyes) * rays).sum(dim=1).abs() / distance
        if float(factor.min()) > MAX_UNIT_FACTOR or float(factor.max()) < 1.0 / MAX_UNIT_FACTOR:
            raise InvalidInputError(
                f"T_cam_from_world: by its size the object is {float(distance[0]):.3g} away, by "
                f"the cameras' rays "
                f"{float(factor[0] * distance[0]):.3g}; give translations in the mesh's unit",
                images=(self.photographs[0].index,),
            )

    def centres(self, T: Tensor) -> Tensor:
        """(N, 3) the object's centres of poses (N, 4, 4)."""
        return point_in_cameras(T, self.describer.centre)

    @cached_property
    def places(self) -> tuple[Tensor, Tensor]:
        """The object's centre (V, 3) from each photograph alone, and its precision, see
        :meth:`precision`."""
        place = self.centres(torch.stack([p.poses[0] for p in self.photographs]))
        return place, self.precision(place, torch.arange(len(place)))

    def precision(self, place: Tensor, source: Tensor) -> Tensor:
        """(N, 3, 3) inverse covariances of centres (N, 3) that photographs ``source`` (N,) alone
        tell."""
        ray = place - self.eyes[source]
        distance = torch.linalg.vector_norm(ray, dim=1)[:, None, None]
        along = (ray[:, :, None] * ray[:, None]) / distance**2
        across = (CENTRE_ERROR * self.describer.radius) ** 2 + (RIG_ERROR * distance) ** 2
        precision: Tensor = (torch.eye(3).double() - along) / across + along / (
            DEPTH_ERROR * distance
        ) ** 2
        return precision

    def candidates(self) -> Tensor:
        """(M, 4, 4) distinct world poses of all hypotheses, moved to where the photographs agree
        that the object is, most promising first."""
        T = torch.cat([p.poses for p in self.photographs])
        source = torch.tensor(
            [v for v, p in enumerate(self.photographs) for _ in p.result.hypotheses]
        )
        place = self.centres(T)
        others, theirs = self.places
        own = self.precision(place, source)
        gap = (place[:, None] - others)[..., None]
        total = torch.linalg.inv(own)[:, None] + torch.linalg.inv(theirs)
        agree = (gap.mT @ torch.linalg.solve(total, gap))[..., 0, 0] <= MAX_PLACE_DISTANCE
        agree = agree.scatter(1, source[:, None], False)[:, :, None, None].double()
        A = own + (agree * theirs).sum(dim=1)
        b = own @ place[..., None] + (agree * (theirs @ others[..., None])).sum(dim=1)
        agreed = torch.linalg.solve(A, b)[..., 0]
        T = pose_around(T[:, :3, :3], agreed, self.describer.centre)
        return T[self.distinct(T, _bounded(self.ranks(T)).sum(dim=0))[:FITTED_CANDIDATES]]

    def distinct(self, T: Tensor, score: Tensor) -> Tensor:
        """Indices of world poses, best first, without those that are nearly equal to a better
        one."""
        kept: list[int] = []
        place = self.centres(T)
        for k in score.argsort(descending=True, stable=True).tolist():
            near = self.angles(T[kept], T[k : k + 1])[:, 0] <= SAME_ANGLE
            shift = torch.linalg.vector_norm(place[kept] - place[k], dim=1)
            if not bool((near & (shift <= SAME_SHIFT * self.describer.radius)).any()):
                kept.append(k)
        return torch.tensor(kept)

    def angles(self, T: Tensor, others: Tensor, *, shape_alone: bool = False) -> Tensor:
        """(M, N) degrees between the rotations of poses (M, 4, 4) and (N, 4, 4), up to symmetries
        after which they are the same answer, or of the shape alone."""
        symmetries = self.symmetries if shape_alone else self.answer_symmetries
        return angles_between(T[:, :3, :3], others[:, :3, :3], symmetries)

    def ranks(self, T: Tensor) -> Tensor:
        """(V, M) log S of the best view of the bank near world poses, minus that of the best view
        of all."""
        ranks = []
        views = self.target.bank.rotations.cpu().double()
        for photograph in self.photographs:
            scores = photograph.rankings[0].scores[0].cpu().double()
            log = scores.clamp(min=torch.finfo(torch.float64).tiny).log()
            angles = angles_between(self.allocentric(photograph, T)[0], views, self.symmetries)
            near = angles <= angles.amin(dim=1, keepdim=True).clamp(min=SAME_ANGLE)
            ranks.append(torch.where(near, log, -torch.inf).amax(dim=1) - log.max())
        return torch.stack(ranks)

    def allocentric(self, photograph: RigPhotograph, T: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations (M, 3, 3) as seen by a camera that looks straight at the object, and its
        distances (M,)."""
        position = self.centres(photograph.camera @ T)
        R = rotation_towards(position).mT @ photograph.camera[:3, :3] @ T[:, :3, :3]
        return R, torch.linalg.vector_norm(position, dim=1)

    @cached_property
    def problems(self) -> list[ContourProblem]:
        """A pose in each photograph: at full size, half of it, and a quarter."""
        crops = EdgeCrops.cat([p.crops for p in self.photographs])
        K = torch.stack([p.photograph.K for p in self.photographs])
        index = torch.arange(len(self.photographs))
        return [
            ContourProblem.of(self.describer.contours, crops, K, index, factor=factor)
            for factor in (1, 2, 4)
        ]

    def tied(self, problem: ContourProblem, T: Tensor) -> tuple[RigProblem, Tensor]:
        """The problem of M world poses in all photographs, and their poses (M V, 4, 4) in the
        cameras."""
        M = len(T)
        V = len(self.photographs)
        every = torch.arange(V).repeat(M)
        pose = torch.arange(M).repeat_interleave(V)
        cams = self.cameras[every] @ T[pose]
        alone, covariance = self.found_alone(cams, every)
        # From errors of the model's origin to those of the object's centre.
        lever = torch.eye(6, dtype=torch.float64).repeat(len(cams), 1, 1)
        lever[:, 3:, :3] = cross_matrix(alone[:, :3, :3] @ self.describer.centre)
        values, vectors = torch.linalg.eigh(lever.mT @ _inverse(covariance) @ lever)
        root = (vectors * values.clamp(min=0.0).sqrt()[:, None]).mT
        axes = (self.cameras[:, :3, :3] @ self.cameras[0, :3, :3].mT)[every]
        return RigProblem(
            **vars(problem[every]), axes=axes, group=pose, alone=alone, root=root
        ), cams

    def found_alone(self, cams: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
        """The poses (N, 4, 4) nearest to given ones that photographs ``source`` (N,) alone found,
        and their covariances (N, 6, 6): NaN where there is none within ``SAME_ANGLE``."""
        T = cams.clone()
        C = torch.full((len(cams), 6, 6), torch.nan, dtype=torch.float64)
        for n, (pose, v) in enumerate(zip(cams, source.tolist(), strict=True)):
            for hypothesis in self.photographs[v].result.hypotheses:
                near = (
                    float(rotation_error(hypothesis.projection[0][:3, :3], pose[:3, :3]))
                    <= SAME_ANGLE
                )
                if near and hypothesis.covariance is not None and bool(C[n].isnan().all()):
                    T[n] = hypothesis.projection[0]
                    C[n] = hypothesis.covariance
        return T, C

    def fitted(
        self, problem: ContourProblem, T: Tensor, radii: Sequence[float]
    ) -> tuple[Tensor, Tensor, ContourState]:
        """World poses (M, 4, 4) after a joint fit, their edge supports (V, M), and their state. If
        the fit does not improve the support of all photographs together, the initial pose is
        kept."""
        V = len(self.photographs)
        each, cams = self.tied(problem, T)
        start = each.state(cams)
        before, weighted_before = each.supports(start)
        found = each.descend(start, radii)
        after, weighted = each.supports(found)
        better = (each.summed(weighted) > each.summed(weighted_before))[each.group]
        state = ContourState.cat([start, found])[torch.arange(len(cams)) + len(cams) * better]
        support = torch.where(better, after, before).view(len(T), V).T
        return torch.linalg.inv(self.cameras[0]) @ state.T[::V], support, state

    def answer(self) -> JointPoses:
        """Candidates, fitted in all photographs and ordered by the sum of their scores; the
        hypotheses of one."""
        if len(self.photographs) == 1:
            return self.hypotheses_of_one()
        full, half, quarter = self.problems
        T = self.candidates()
        # for those that are far off; the others lose by it
        moved, _, _ = self.fitted(quarter, T, QUARTER_SIZE_RADII)
        T, support, _ = self.fitted(half, torch.cat([T, moved]), FIRST_RADII)
        promising = (SUPPORT_WEIGHT * support + _bounded(self.ranks(T))).sum(dim=0)
        chosen = self.distinct(T, promising)[:JUDGED_CANDIDATES]
        T = T[chosen]
        support = support[:, chosen]
        best = min(FINISHED_CANDIDATES, len(T))
        T[:best], support[:, :best], state = self.fitted(full, T[:best], FULL_SIZE_RADII)
        covariance = torch.full((len(T), 6, 6), torch.nan, dtype=torch.float64)
        covariance[:best] = self.covariances(T[:best], state)
        evidence = self.evidence(T, support)
        sees = torch.stack([p.sees(self.describer.hull, T) for p in self.photographs])
        scores = evidence.scores(self.score_weights)
        scores = _bounded(torch.where(sees, scores, -torch.inf))
        order = (self.weights(T[0]) @ scores).argsort(descending=True, stable=True)
        return JointPoses(T[order], evidence[:, order], scores[:, order], covariance[order])

    def hypotheses_of_one(self) -> JointPoses:
        (photograph,) = self.photographs
        found = photograph.result.hypotheses
        evidence = Evidence.of_hypotheses([h.evidence for h in found])[None]
        P = in_frames(self.cameras[:, :3, :3])
        unknown = torch.full((6, 6), torch.nan).double()
        C = torch.stack([unknown if h.covariance is None else h.covariance for h in found])
        scores = _bounded(evidence.scores(self.score_weights))
        return JointPoses(photograph.poses, evidence, scores, P.mT @ C @ P)

    def covariances(self, T: Tensor, state: ContourState) -> Tensor:
        """(M, 6, 6) of finished world poses, from those of each photograph: its contours', or that
        found alone. They are larger where the photographs alone contradict the joint pose, by the
        mean of their squared gaps: the cameras' poses have errors."""
        each, cams = self.tied(self.problems[0], T)
        measured = each.measured_edges(state, FULL_SIZE_RADII[-1])
        radius = self.describer.radius
        seen, _ = pose_covariance(
            measured, state.points, state.T, each.K, each.centre, radius=radius
        )
        every = torch.arange(len(self.photographs)).repeat(len(T))
        _, alone = self.found_alone(cams, every)
        known = alone.isfinite().all(dim=-1).all(dim=-1)
        better = ~(alone.logdet() >= seen.logdet()) & known
        precision = _inverse(torch.where(better[:, None, None], alone, seen))
        weights = torch.cat([self.weights(one) for one in T])
        P = in_frames(self.cameras[every, :3, :3])
        covariance: Tensor = torch.linalg.inv(
            each.summed(weights[:, None, None] * (P.mT @ precision @ P))
        )
        freedom = 6.0 * each.summed(known.double()) - 6.0
        misfit = each.summed(each.gaps(state.T).square().sum(dim=(1, 2))) / freedom.clamp(min=6.0)
        return covariance * misfit.clamp(min=1.0)[:, None, None]

    def weights(self, T: Tensor) -> Tensor:
        """(V,) in (0, 1] weights of photographs: those from nearly the same side of a world pose
        (4, 4) share one."""
        side = F.normalize(self.eyes - self.centres(T[None]), dim=1)
        angle = torch.rad2deg((side @ side.T).clamp(-1.0, 1.0).acos())
        return 1.0 / (1.0 - angle / SAME_DIRECTION).clamp(min=0.0).fill_diagonal_(1.0).sum(dim=1)

    def evidence(self, T: Tensor, support: Tensor) -> Evidence:
        """(V, M) of world poses with edge supports (V, M); details in comparison with the first."""
        parts = []
        ranks = self.ranks(T)
        for v, photograph in enumerate(self.photographs):
            cameras = photograph.photograph.K.expand(len(T), 3, 3)
            view = torch.zeros(len(T), dtype=torch.long)
            seen = photograph.camera @ T
            poses = Hypotheses.at(seen, cameras, self.describer.centre, view, ranks[v])
            poses = replace(poses, edge_support=support[v])
            evidence = evidence_of(self.target, photograph, poses)
            parts.append(replace(evidence, details=self.details(photograph, T)))
        return Evidence.stack(parts)

    def details(self, photograph: RigPhotograph, T: Tensor) -> Tensor:
        """(M,) how much the details of world poses (M, 4, 4) are better than those of the first in
        a photograph."""
        K = photograph.photograph.K.expand(len(T), 3, 3)
        index = torch.zeros(len(T), dtype=torch.long)
        scores, _ = compare_details(
            self.describer.contours, photograph.crops, K, photograph.camera @ T, index
        )
        return scores[:, 0]

    def lost(self, answer: JointPoses) -> dict[int, str]:
        """Why photographs do not show the best pose, by their index; {} if none shows it."""
        reasons: dict[int, str] = {}
        best = answer.evidence[:, 0]
        pairs = list(zip(best.similarity.tolist(), best.edge_support.tolist(), strict=True))
        sees = [bool(p.sees(self.describer.hull, answer.T[:1])) for p in self.photographs]
        found = [
            refinement_confidence({"similarity": similarity, "edge_support": support})
            if seen
            else 0.0
            for (similarity, support), seen in zip(pairs, sees, strict=True)
        ]
        for v, photograph in enumerate(self.photographs):
            if not sees[v]:
                reasons[photograph.index] = ELSEWHERE
            elif found[v] < self.target.pipeline.fit.lost_confidence * max(found):
                numbers = "similarity {:.2f}, edge support {:.2f}".format(*pairs[v])
                reasons[photograph.index] = (
                    f"the object is not seen where the other photographs have it ({numbers})"
                )
        return reasons if len(reasons) < len(self.photographs) else {}

    def hypothesis(self, answer: JointPoses, m: int, mean: Evidence) -> Hypothesis:
        """World pose ``m`` as it is reported, with ``mean`` evidence of the photographs."""
        first = self.photographs[0]
        T = answer.T[m]
        C = answer.covariance[m]
        (R,), (distance,) = self.allocentric(first, T[None])
        evidence = mean.named(m)
        return Hypothesis(
            rotation=T[:3, :3].clone(),
            translation=T[:3, 3].clone(),
            score=evidence["similarity"],
            evidence=evidence,
            allocentric_rotation=R,
            distance=float(distance),
            projection=(first.camera @ T, first.photograph.K),
            view=nearest_view(self.target, R),
            edge_support=evidence["edge_support"],
            covariance=C.clone() if bool(C.isfinite().all()) else None,
        )


def _rotations(symmetries: Tensor | None) -> Tensor:
    """(S, 3, 3) of symmetries (S, 4, 4), the identity for None."""
    return torch.eye(3).double()[None] if symmetries is None else symmetries[:, :3, :3].double()


def _inverse(covariance: Tensor) -> Tensor:
    """(N, 6, 6) precisions of covariances, nearly 0 where they are unknown (NaN)."""
    known = covariance.isfinite().all(dim=-1).all(dim=-1)[:, None, None]
    none = 1e-12 * torch.eye(6, dtype=torch.float64)
    return torch.where(
        known, torch.linalg.inv(torch.where(known, covariance, torch.eye(6).double())), none
    )


def _bounded(scores: Tensor) -> Tensor:
    """(V, M) scores, at least ``MAX_MARGIN`` below the best of each photograph."""
    best = scores.amax(dim=1, keepdim=True)
    return torch.where(best.isfinite(), torch.maximum(scores, best - MAX_MARGIN), 0.0)
