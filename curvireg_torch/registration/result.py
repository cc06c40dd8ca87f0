"""The results of a registration: poses with their probabilities."""

import html
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Generic, Self, TypeVar, overload

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..errors import CurviregError, LostObjectError
from ..fitting.exactness import Exactness, exactness_of
from ..geometry.calibration import Camera
from ..geometry.cameras import transform
from ..geometry.pose_prior import PosePrior
from ..geometry.viewpoint import angles_between, viewpoint_from_rotation
from ..matching import Ranking
from ..pipeline import FitSettings
from .confidence import RELIABLE, two_decimals

Value = TypeVar("Value")

# Radians of standard deviation from which the rotation about an axis counts as unknown
UNKNOWN_ROTATION = 1.0
# Evidence of as many keypoints as a pose can begin from: they determine it, whatever its contours
# tell
DETERMINING_KEYPOINTS = math.log1p(FitSettings().min_keypoints - FitSettings().chance_keypoints)
# Of :func:`.confidence.undetermined_axes`, from which the rotation is not determined
MOST_UNDETERMINED = 1.0
# Fraction of the first pose's probability from which another one makes the answer ambiguous
RIVAL_FRACTION = 0.5
HALF_TURN = 150.0  # Degrees from which the rotation between two poses counts as a half turn
AXIS_TOLERANCE = 15.0  # Degrees within which two axes are the same answer
# Degrees within which two directions of view count as mirror images of each other
MIRROR_ANGLE = 30.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One candidate pose of the object, in the mesh file's own frame and unit.

    Attributes:
        rotation: (3, 3) float64, ``x_cam = R x_model + t``, OpenCV camera.
        translation: (3,) float64 in model units, None without a camera matrix.
        score: normalised correlation of photograph and rendered view in [0, 1]; of a tracked pose,
            how clearly and how near to its outline the object's colours end.
        evidence: the features that the hypotheses are ordered by; of a tracked pose, those of its
            confidence.
        allocentric_rotation: (3, 3) float64, relative to a camera that looks straight at the
            object.
        distance: of the object's centre in model units.
        projection: (4, 4) and (3, 3) float64 pose and camera matrix in px, which project the mesh
            onto the photograph; without a camera matrix, those of a camera that looks straight at
            the object.
        view: index of the bank's view that the hypothesis started from.
        edge_support: strength of the image edges under the projected contours, in [0, 1]; None
            without contour fit.
        covariance: (6, 6) float64 of rotation (rad) about the camera's axes and translation (model
            units) along them, ``R_true = exp([w]x) R``, ``t_true = t + e``, if pose and camera
            matrix are right; None without a camera matrix, without contour fit, and where too few
            edges were found.

    Example:
        >>> from curvireg_torch.registration.hypotheses import Hypotheses, hypothesis_of
        >>> T = torch.eye(4).double()[None]; T[:, 2, 3] = 5.0
        >>> view = torch.zeros(1, dtype=torch.long)
        >>> centre = torch.zeros(3).double()
        >>> poses = Hypotheses.at(T, torch.eye(3).double()[None], centre, view, view.double())
        >>> hypothesis = hypothesis_of(poses, 0, {"similarity": 0.8})
        >>> hypothesis.score, hypothesis.distance
        (0.8, 5.0)
    """

    rotation: Tensor
    translation: Tensor | None
    score: float
    evidence: Mapping[str, float]
    allocentric_rotation: Tensor
    distance: float
    projection: tuple[Tensor, Tensor]
    view: int
    edge_support: float | None = None
    covariance: Tensor | None = None

    @property
    def viewpoint(self) -> tuple[float, float, float]:
        """Azimuth, elevation and theta of ``rotation`` in degrees (PASCAL3D+)."""
        azimuth, elevation, theta = viewpoint_from_rotation(self.rotation)
        return float(azimuth), float(elevation), float(theta)

    @property
    def standard_deviations(self) -> tuple[Tensor, Tensor] | None:
        """(3,) degrees about and (3,) model units along the camera's axes; None without a
        covariance. ``inf`` marks what the contours do not determine: deviations from a radian, or
        from half the distance."""
        if self.covariance is None:
            return None
        rotation, translation = self.covariance.diagonal().sqrt().split(3)
        rotation = torch.where(rotation < UNKNOWN_ROTATION, torch.rad2deg(rotation), torch.inf)
        return rotation, torch.where(translation < 0.5 * self.distance, translation, torch.inf)

    @property
    def exactness(self) -> Exactness | None:
        """How exact the pose is if it is right; None without a covariance."""
        if self.covariance is None or self.translation is None:
            return None
        return exactness_of(
            self.covariance,
            self.rotation,
            self.translation,
            self.allocentric_rotation,
            self.distance,
        )

    @property
    def transform(self) -> Tensor | None:
        """(4, 4) float64 ``T_cam_from_model``, None without a camera matrix."""
        return None if self.translation is None else transform(self.rotation, self.translation)

    def pose_dict(self) -> dict[str, Any]:
        """``rotation``, ``translation`` and ``viewpoint`` as JSON values."""
        return {
            "rotation": self.rotation.tolist(),
            "translation": _plain(self.translation),
            "viewpoint": dict(zip(("azimuth", "elevation", "theta"), self.viewpoint, strict=True)),
        }


@dataclass(frozen=True, eq=False)
class Detection:
    """Where the object was found in a photograph that came without a box.

    Attributes:
        box: (4,) float64 x0, y0, x1, y1 in px, around the projected mesh.
        score: probability that the photograph shows the object there.
        response: of the proposal that led here, see :class:`.Proposals`.
        boxes: (P, 4) float64, all proposals, the results' boxes first, with their ``responses``
            (P,).

    Example:
        >>> box = torch.tensor([10.0, 20.0, 110.0, 90.0]).double()
        >>> Detection(box, 0.97, 8.0, box[None], torch.tensor([8.0])).score
        0.97
    """

    box: Tensor
    score: float
    response: float
    boxes: Tensor
    responses: Tensor


@dataclass(frozen=True, eq=False)
class Axis:
    """Where the axis of a nearly round object points, whatever its turn about it.

    Attributes:
        direction: (3,) float64 unit vector in the frame of the pose's rotation.
        probability: that it is within ``tolerance_deg`` of the truth.
        tolerance_deg: degrees.

    Example:
        >>> axis = Axis(torch.tensor([0.0, 0.0, 1.0]), 0.95)
        >>> axis.to_dict()
        {'direction': [0.0, 0.0, 1.0], 'probability': 0.95, 'tolerance_deg': 15.0}
    """

    direction: Tensor
    probability: float
    tolerance_deg: float = AXIS_TOLERANCE

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {**vars(self), "direction": self.direction.tolist()}


@dataclass(frozen=True, eq=False)
class PhotographPose:
    """The pose in one of the photographs that an object was registered in together.

    Attributes:
        T_cam_from_model: (4, 4) float64.
        box: (4,) float64 x0, y0, x1, y1 in px, in which the photograph was compared; None where it
            was not read.
        edge_support, similarity: of the pose in this photograph; None where it was not compared.
        contribution: score by which the photograph prefers the pose to its best rival, of 5 points
            if there is none; 0 if the photograph does not count.
        failure: why the photograph does not count, in words; None if it does.

    Example:
        >>> pose = PhotographPose(torch.eye(4).double(), failure="the photograph is empty")
        >>> pose.to_dict()["translation"], pose.contribution
        ([0.0, 0.0, 0.0], 0.0)
    """

    T_cam_from_model: Tensor
    box: Tensor | None = None
    edge_support: float | None = None
    similarity: float | None = None
    contribution: float = 0.0
    failure: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """All attributes as JSON values, the pose as ``rotation`` and ``translation``."""
        rest = {**vars(self), "box": _plain(self.box)}
        T = rest.pop("T_cam_from_model")
        return {"rotation": T[:3, :3].tolist(), "translation": T[:3, 3].tolist(), **rest}


class _OfBest(Generic[Value]):
    """An attribute of a registration that is one of its best hypothesis."""

    def __init__(self, get: Callable[[Hypothesis], Value]) -> None:
        self._get = get

    @overload
    def __get__(self, result: None, owner: type) -> Self: ...
    @overload
    def __get__(self, result: "Registration", owner: type) -> Value: ...
    def __get__(self, result: "Registration | None", owner: type) -> Self | Value:
        return self if result is None else self._get(result.hypotheses[0])


@dataclass(frozen=True, eq=False)
class Registration:
    """Poses of one object in one photograph. The attributes of the best :class:`Hypothesis` are
    attributes of the registration too; ``covariance`` and ``standard_deviations`` are None where it
    is not reliable.

    Attributes:
        hypotheses: distinct poses, best first; all but the first are rivals, such as the pose seen
            from behind.
        probabilities: of each hypothesis to be within 30 degrees of the truth, times
            ``detection.score`` for an object without a box; empty for a pipeline that was not
            calibrated.
        ranking: scores of the bank's views for this photograph (B = 1).
        confidence_features: what the confidence is computed from, see
            :func:`.confidence.confidence_features`.
        detection: where the object was found; None if its box was given.
        corrected_box: (4,) float64, the box around a pose that replaced the given one, because the
            photograph agrees better with what was found in it; else None.
        prior: the limits on the pose that were given.
        prior_contradiction: "better outside": a pose outside the limits fits better, or the box
            asks for a distance outside; "at the limit": the pose lies within a degree, or 1 % of
            the distance, of a limit. None otherwise.
        warnings: what is questionable about box, camera and mesh, in words; a result with one is
            not reliable.
        notes: what the mesh lacks, as its textures, or what was left out of it, in words; reliable
            all the same.
        feature_is_hidden: whether a small feature of the mesh tells turns of it apart, as the pull
            tab of a can does, and the photograph does not show it: the pose is right up to these
            turns.
        mesh_index: of several meshes, which one this is a pose of.
        mesh_probabilities: of each of several exact meshes, that one of its poses is right; they
            are rivals, whose poses share one probability.
        axis: of a nearly round object, where its axis points, whatever its turn about it; None for
            other objects, similar meshes and pipelines without calibration.
        pair_probability: that one of the first two rivals is right, where they are each other's
            half turn or mirror image; else None.
        camera: of the photograph without its distortion; its ``source`` tells whether it was given,
            and ``focal_deviation`` how well its focal length is known. None without a camera, and
            of several photographs.
        views: of :meth:`.Registrar.register_views`, the pose in each photograph; poses and
            covariance are then ``T_world_from_model``, along the world's axes.
        reliable_from: confidence from which it is called reliable.

    Example:
        >>> import curvireg_torch as cr
        >>> scene = cr.synthetic.demo_scene()
        >>> views = cr.sample_views(azimuth_step=30, elevations=[20])
        >>> bank = cr.ViewBank.build(scene.mesh, views, image_size=64, progress=False)
        >>> result = cr.Registrar(bank)([scene.image], [scene.box], scene.camera_matrix)[0]
        >>> result.rotation.shape, len(result.hypotheses) == len(result.probabilities)
        (torch.Size([3, 3]), True)
    """

    hypotheses: tuple[Hypothesis, ...]
    probabilities: tuple[float, ...]
    ranking: Ranking
    confidence_features: Mapping[str, float | None] = field(default_factory=dict)
    detection: Detection | None = None
    corrected_box: Tensor | None = None
    prior: PosePrior | None = None
    prior_contradiction: str | None = None
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    feature_is_hidden: bool = False
    mesh_index: int = 0
    mesh_probabilities: tuple[float, ...] = ()
    axis: Axis | None = None
    pair_probability: float | None = None
    camera: Camera | None = None
    views: tuple[PhotographPose, ...] = ()
    reliable_from: float = RELIABLE

    ok = True
    """False of a :class:`FailedRegistration`."""

    rotation = _OfBest(lambda best: best.rotation)
    translation = _OfBest(lambda best: best.translation)
    transform = _OfBest(lambda best: best.transform)
    viewpoint = _OfBest(lambda best: best.viewpoint)
    score = _OfBest(lambda best: best.score)
    edge_support = _OfBest(lambda best: best.edge_support)
    allocentric_rotation = _OfBest(lambda best: best.allocentric_rotation)
    distance = _OfBest(lambda best: best.distance)
    projection = _OfBest(lambda best: best.projection)

    @property
    def confidence(self) -> float | None:
        """Probability of the best pose, the first of ``probabilities``; None for pipelines without
        calibration."""
        return self.probabilities[0] if self.probabilities else None

    @property
    def no_match_probability(self) -> float | None:
        """Probability that no hypothesis is right; None for pipelines without calibration."""
        every = self.mesh_probabilities or self.probabilities
        return max(0.0, 1.0 - sum(every)) if self.probabilities else None

    @property
    def ambiguous(self) -> str | None:
        """How the first pose and those nearly as probable, or that make a reliable pair with it,
        differ: "half turn", "mirror" or "several", as are those that only a hidden feature of the
        mesh tells apart; "mesh 0 or 1" of meshes that are; else None."""
        if likely_meshes := self._likely_meshes:
            return f"mesh {' or '.join(str(k) for k in likely_meshes)}"
        pair = self.pair_probability
        rivals = likely_rivals(self.probabilities, pair, is_hidden=self.feature_is_hidden)
        likely = [0, *rivals]
        poses = [self.hypotheses[k].allocentric_rotation for k in likely]
        named = ambiguity(torch.stack(poses))
        return "several" if named is None and self.feature_is_hidden else named

    @property
    def is_doubtful(self) -> bool:
        """Whether the confidence is unknown or below ``reliable_from``."""
        return self.confidence is None or not self.confidence >= self.reliable_from

    @property
    def reliable(self) -> bool:
        """Whether the confidence is at least ``reliable_from``, without ``warnings`` or a better
        pose outside the prior, and the contours determine the rotation, or as many keypoints agree
        as a pose can begin from; if False, the pose is a guess."""
        best = self.hypotheses[0]
        if self.is_doubtful or self.is_questioned:
            return False
        if best.translation is None or best.edge_support is None:  # nothing to determine them by
            return True
        if best.evidence.get("keypoints", 0.0) >= DETERMINING_KEYPOINTS:
            return True
        deviations = best.standard_deviations
        if deviations is None or not bool(deviations[0].isfinite().any()):
            return False
        return (self.confidence_features.get("undetermined") or 0.0) < MOST_UNDETERMINED

    @property
    def confidence_bound(self) -> float:
        """Most confidence of poses that follow from this one: 1, or less than a reliable answer has
        where something else than its confidence makes this one unsure."""
        certain = replace(self, probabilities=(1.0,))
        return 1.0 if certain.reliable else math.nextafter(self.reliable_from, 0.0)

    @property
    def _likely_meshes(self) -> list[int]:
        """The numbers of this mesh and of others that are nearly as probable, if there are any."""
        every = self.mesh_probabilities
        if not every:
            return []
        least = RIVAL_FRACTION * every[self.mesh_index]
        likely = [k for k, p in enumerate(every) if k == self.mesh_index or p >= least]
        return likely if len(likely) > 1 else []

    @property
    def is_questioned(self) -> bool:
        """Whether there are ``warnings``, or a better pose outside the prior."""
        return bool(self.warnings) or self.prior_contradiction == "better outside"

    @property
    def axis_is_reliable(self) -> bool:
        """Whether the probability of the ``axis`` is at least ``reliable_from``, and nothing is
        questionable; the turn about it may be a guess."""
        if self.axis is None or self.is_questioned:
            return False
        return self.axis.probability >= self.reliable_from

    def scaled(self, factor: float) -> "Registration":
        """The same with all probabilities times a factor in [0, 1]."""
        pair = self.pair_probability
        axis = self.axis
        return replace(
            self,
            probabilities=tuple(factor * p for p in self.probabilities),
            mesh_probabilities=tuple(factor * p for p in self.mesh_probabilities),
            pair_probability=None if pair is None else factor * pair,
            axis=None if axis is None else replace(axis, probability=factor * axis.probability),
        )

    @property
    def verdict(self) -> str:
        """How sure the answer is: "reliable"; "reliable axis": the axis of a nearly round object is
        certain, the turn about it is not; "no match" if it is more probable that no hypothesis is
        right than that the first one is; else "unsure". Every command, page and picture uses these
        words, and "lost" or "failed" of a :class:`FailedRegistration`."""
        if self.reliable:
            return "reliable"
        if self.axis_is_reliable:
            return "reliable axis"
        no_match = self.no_match_probability
        if self.confidence is None or no_match is None or no_match <= self.confidence:
            return "unsure"
        return "no match"

    @property
    def quaternion(self) -> Tensor:
        """(4,) float64 unit quaternion (w, x, y, z) of ``rotation``, w >= 0."""
        x, y, z, w = Rotation.from_matrix(self.rotation.numpy()).as_quat(canonical=True)
        return torch.tensor([w, x, y, z], dtype=torch.float64)

    @property
    def T_cam_from_model(self) -> Tensor | None:  # noqa: N802
        """(4, 4) float64, None without a camera matrix, and for several photographs, whose
        ``views`` have it."""
        return None if self.views else self.transform

    def __repr__(self) -> str:
        """At most ten lines."""
        confidence = "not calibrated" if self.confidence is None else two_decimals(self.confidence)
        rows = [", ".join(f"{v:8.4f}" for v in row) for row in self.rotation.tolist()]
        t = (
            None
            if self.translation is None
            else ", ".join(f"{v:.6g}" for v in self.translation.tolist())
        )
        lines = [
            f"Registration: {self.verdict}, confidence {confidence}",
            f"rotation    [[{rows[0]}],",
            *(f"             [{row}]{end}" for row, end in zip(rows[1:], (",", "]"), strict=True)),
            f"translation {'unknown without a camera' if t is None else f'[{t}]'}",
            "viewpoint   azimuth {:.1f}, elevation {:.1f}, theta {:.1f} degrees".format(
                *self.viewpoint
            ),
            f"hypotheses  {len(self.hypotheses)}"
            + (f", {self.ambiguous}" if self.ambiguous else ""),
        ]
        return "\n".join(
            [*lines, *(f"warning     {text}" for text in (self.warnings + self.notes)[:2])]
        )

    def _repr_html_(self) -> str:
        """For notebooks."""
        return f"<pre>{html.escape(repr(self))}</pre>"

    @property
    def covariance(self) -> Tensor | None:
        return self.hypotheses[0].covariance if self.reliable else None

    @property
    def standard_deviations(self) -> tuple[Tensor, Tensor] | None:
        return self.hypotheses[0].standard_deviations if self.reliable else None

    @property
    def exactness(self) -> Exactness | None:
        """Errors that nine in ten reliable answers stay within; the distance holds for the mesh's
        size and the given focal length."""
        return self.hypotheses[0].exactness if self.reliable and not self.views else None

    def to_dict(self) -> dict[str, Any]:
        """Pose, scores and uncertainty as JSON values, under the keys of ``result.json``
        (docs/results.md)."""
        deviations = self.standard_deviations
        document = {
            **self.hypotheses[0].pose_dict(),
            "quaternion": self.quaternion.tolist(),
            "T_cam_from_model": _plain(self.T_cam_from_model),
            "frame": self._frame,
            "score": self.score,
            "verdict": self.verdict,
            "confidence": self.confidence,
            "reliable": self.reliable,
            "warnings": [*self.warnings, *self.notes],
            "probabilities": list(self.probabilities),
            "no_match_probability": self.no_match_probability,
            "ambiguous": self.ambiguous,
            "mesh_probabilities": list(self.mesh_probabilities),
            "pair_probability": self.pair_probability,
            "axis": self.axis and self.axis.to_dict(),
            "feature_is_hidden": self.feature_is_hidden,
            "confidence_features": dict(self.confidence_features),
            "edge_support": self.edge_support,
            "standard_deviations": deviations
            and {"rotation_deg": _finite(deviations[0]), "translation": _finite(deviations[1])},
            "covariance": _plain(self.covariance),
            "exactness": self._exactness_dict(),
            "allocentric_rotation": None if self.views else self.allocentric_rotation.tolist(),
            "corrected_box": _plain(self.corrected_box),
            "camera": self.camera and self.camera.describe(),
            "camera_source": self.camera and self.camera.source,
            "hypotheses": [],
        }
        for one in self.hypotheses:
            terms = {name: float(raw[0, one.view]) for name, raw in self.ranking.terms.items()}
            terms = {name: value for name, value in terms.items() if math.isfinite(value)}
            more = {
                "score": one.score,
                "evidence": dict(one.evidence),
                "view": one.view,
                "terms": terms,
            }
            document["hypotheses"].append({**one.pose_dict(), **more})
        if self.prior is not None:
            document["prior"] = {**self.prior.to_dict(), "contradiction": self.prior_contradiction}
        if self.views:
            document["photographs"] = [view.to_dict() for view in self.views]
        return document

    def _exactness_dict(self) -> dict[str, Any] | None:
        exactness = self.exactness
        return None if exactness is None else {**vars(exactness), "words": exactness.words}

    @property
    def _frame(self) -> str:
        """What the rotation and the translation are relative to."""
        if self.views:
            return "world"
        return "allocentric" if self.translation is None else "camera"


def _plain(values: Tensor | None) -> list[Any] | None:
    return None if values is None else values.tolist()


def _finite(deviations: Tensor) -> list[float | None]:
    """JSON has no infinity: None in its place."""
    return [None if math.isinf(v) else v for v in deviations.tolist()]


@dataclass(frozen=True, eq=False)
class FailedRegistration:
    """A photograph that could not be registered because of its ``error``, which access to a pose
    raises.

    Example:
        >>> from curvireg_torch.errors import ImageError
        >>> failed = FailedRegistration(ImageError("the photograph is empty"))
        >>> failed.ok, failed.verdict
        (False, 'failed')
    """

    error: CurviregError

    ok = False

    @property
    def verdict(self) -> str:
        """Whether the object was not found, "lost", or something else is wrong, "failed"."""
        return verdict_of_error(self.error)

    def __getattr__(self, name: str) -> Any:
        of_pose = {field.name for field in fields(Registration)} | vars(Registration).keys()
        if name.startswith("_") or name not in of_pose:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        raise self.error


Results = list[Registration | FailedRegistration]


def likely_rivals(
    probabilities: Sequence[float], pair_probability: float | None, *, is_hidden: bool = False
) -> list[int]:
    """Numbers of the hypotheses that are nearly as probable as the first; the second is, too, where
    the pair of both is reliable and the first alone is not, unless what tells turns of the mesh
    apart ``is_hidden``."""
    if not probabilities:
        return []
    first = probabilities[0]
    likely = [p >= RIVAL_FRACTION * first for p in probabilities]
    is_pair = first < RELIABLE <= (pair_probability or 0.0)
    if len(likely) > 1 and is_pair and not is_hidden:
        likely[1] = True
    return [k for k, is_likely in enumerate(likely) if is_likely and k > 0]


def kinds_of(warnings: Iterable[str]) -> dict[str, list[str]]:
    """Warnings by what they say but for numbers: each photograph contradicts a wrong focal length
    with another one."""
    kinds: dict[str, list[str]] = {}
    for text in warnings:
        kinds.setdefault(re.sub(r"\d+", "", text), []).append(text)
    return kinds


def ambiguity(rotations: Tensor) -> str | None:
    """How poses (K, 3, 3) differ, in words; None for a single one. "half turn": by a rotation of
    nearly 180 degrees; "mirror": they are seen from directions that are mirror images at a
    coordinate plane of the mesh; "several": anything else, or more than two."""
    if len(rotations) < 2:
        return None
    if len(rotations) > 2:
        return "several"
    first, second = rotations.double()
    if float(angles_between(first[None], second[None])) >= HALF_TURN:
        return "half turn"
    # the optical axis at the three planes
    mirrored = first[2] * (1.0 - 2.0 * torch.eye(3, dtype=torch.float64))
    angles = torch.rad2deg((mirrored @ second[2]).clamp(-1.0, 1.0).acos())
    return "mirror" if float(angles.min()) <= MIRROR_ANGLE else "several"


def verdict_of_error(error: Exception) -> str:
    """The verdict on a photograph without a pose: "lost" or "failed"."""
    return "lost" if isinstance(error, LostObjectError) else "failed"
