"""The settings of a method that may be chosen, in one frozen value: the only source of their
defaults, and what docs/experiments.md varies. Other constants of a step stand at the top of its
file."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from dataclasses import field as dataclass_field
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

from torch import nn

from .errors import InvalidInputError, MissingFileError
from .evidence import EvidenceWeights
from .features.fields import DEPTH_FIELDS, FIELDS
from .features.learned_field import SHA256
from .filters.curvilinear import FORMULAS
from .geometry import ViewSphere, paper_views, sample_views, uniform_views
from .geometry.viewpoint import DEFAULT_DISTANCE
from .terms import TERMS, Appearance, BoxShape, Correlation, Repeatability, Term, check_box_jitter
from .utils.checks import check_integer, check_option, check_positive, check_probability
from .utils.choices import BOX_KINDS
from .utils.choices import DEFAULT as DEFAULT
from .utils.files import tensor_digest

__all__ = [
    "DEPTH_FIELDS",
    "FIELDS",
    "PRESETS",
    "BankSettings",
    "DetectionSettings",
    "FitSettings",
    "Pipeline",
    "ViewPolicy",
]
VERSION = 3  # of the JSON form
CUSTOM = "custom:"  # Prefix of the name of a field that is passed with each call

Settings = TypeVar("Settings")


def _convert_integers(
    settings: object, names: tuple[str, ...], *, prefix: str = "", least: int = 1
) -> None:
    """Replace integers, as of numpy, by Python's, which JSON has."""
    for name in names:
        value = check_integer(getattr(settings, name), f"{prefix}{name}", least=least)
        object.__setattr__(settings, name, value)


@dataclass(frozen=True)
class ViewPolicy:
    """Which viewpoints a bank contains.

    Attributes:
        pose: "any": nothing is known. "upright": the object stands upright and is not seen from far
            below. "paper": the paper's grid, see :func:`curvireg_torch.geometry.paper_views`.
            "given": the views were passed by the caller.
        directions, theta_step: of "any": number of viewing directions on the sphere, and degrees
            between in-plane rotations.
        azimuth_step, elevations: of "upright", degrees.
        distance: of the camera from the object's centre, in object radii; not of "paper".
        frame: in which azimuth and elevation are measured. "own": the mesh's. "principal": that of
            its principal axes, see :func:`curvireg_torch.mesh.normalization_transform`. Poses are
            reported in the mesh's own frame.

    Example:
        >>> len(ViewPolicy().sphere()), len(ViewPolicy(pose="upright").sphere())
        (7200, 288)
    """

    pose: str = "any"
    directions: int = 300
    theta_step: float = 15.0
    azimuth_step: float = 10.0
    elevations: tuple[float, ...] = (-10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0)
    distance: float = DEFAULT_DISTANCE
    frame: str = "own"

    def __post_init__(self) -> None:
        check_option(self.pose, ("any", "upright", "paper", "given"), "pose")
        check_option(self.frame, ("own", "principal"), "frame")
        check_positive(self.theta_step, "theta_step")
        object.__setattr__(self, "elevations", tuple(float(e) for e in self.elevations))

    def key_fields(self) -> dict[str, Any]:
        """The attributes that decide the viewpoints; the others belong to another ``pose``."""
        names = {
            "any": ("directions", "theta_step", "distance"),
            "upright": ("azimuth_step", "elevations", "distance"),
        }
        return {name: getattr(self, name) for name in ("pose", "frame", *names.get(self.pose, ()))}

    def sphere(self, up: str = "z") -> ViewSphere:
        """The viewpoints; ``up`` is the axis of the mesh that points up, for "upright"."""
        if self.pose == "given":
            raise InvalidInputError(
                "views: the views of this pipeline were passed by the caller; pass them again"
            )
        if self.pose == "paper":
            return paper_views().for_up(up)
        if self.pose == "upright":
            grid = sample_views(
                azimuth_step=self.azimuth_step,
                elevations=self.elevations,
                distances=[self.distance],
            )
            return grid.for_up(up)
        count = max(1, round(360.0 / self.theta_step))
        thetas = [360.0 * i / count for i in range(count)]
        return uniform_views(self.directions, thetas=thetas, distances=[self.distance])


@dataclass(frozen=True)
class BankSettings:
    """How views are rendered and described. Photographs are cropped and described in the same way.

    Attributes:
        image_size: side of views and crops in px.
        camera: "perspective" or "orthographic".
        margin: space around the object's box, as a fraction of its longer side.
        depth_field: name in ``DEPTH_FIELDS``. "CS" is :func:`depth_curvilinear_saliency` with
            ``sigma`` and ``formula``; the others, with which the paper compares it, use their
            defaults.
        grid, bins, block, clip: of :func:`hog`.
        point_fraction: of :func:`field_points`.

    Example:
        >>> BankSettings(image_size=64).grid
        8
    """

    image_size: int = 128
    camera: str = "perspective"
    margin: float = 0.1
    depth_field: str = "CS"
    sigma: float = 0.8
    formula: str = "geometric"
    grid: int = 8
    bins: int = 9
    block: int = 2
    clip: float = 0.2
    point_fraction: float = 0.04

    def __post_init__(self) -> None:
        check_option(self.camera, ("perspective", "orthographic"), "camera")
        check_option(self.depth_field, DEPTH_FIELDS, "depth_field")
        check_positive(self.margin, "margin", zero_ok=True)
        _convert_integers(self, ("image_size", "grid", "bins", "block"))
        if self.image_size < self.grid:
            raise InvalidInputError(
                f"image_size: expected at least grid = {self.grid}, got {self.image_size}"
            )
        check_option(self.formula, FORMULAS, "formula")
        check_positive(self.sigma, "sigma", zero_ok=True)
        if self.block > self.grid or not 0.0 < self.clip <= 1.0:
            raise InvalidInputError(
                f"hog: expected 1 <= block <= grid and clip in (0, 1], got {self}"
            )


@dataclass(frozen=True)
class DetectionSettings:
    """How an object without a box is searched for, see
    :class:`curvireg_torch.registration.Detector`.

    Attributes:
        views: number of views that represent all of a bank.
        min_size: longer side of the smallest object that is searched for, as a fraction of the
            photograph's.
        proposals: number of boxes that are compared with all views of the bank.

    Example:
        >>> replace(Pipeline(), detection=DetectionSettings(proposals=40)).detection.views
        96
    """

    views: int = 96
    min_size: float = 0.08
    proposals: int = 20

    def __post_init__(self) -> None:
        _convert_integers(self, ("views", "proposals"), prefix="detection: ")
        if not 0.02 <= self.min_size <= 1.0:
            raise InvalidInputError(
                f"detection: min_size: expected a fraction in [0.02, 1], got {self.min_size}"
            )


@dataclass(frozen=True)
class FitSettings:
    """How views become poses, and poses an answer. Files of pipelines name them in an ablation;
    confidences are calibrated for the defaults.

    Attributes:
        screened_views: best distinct views of an exact mesh that get a short contour fit, which
            decides with their rank which become hypotheses.
        screening_weight: of the edge support that a short fit reaches, beside log S, in that
            choice.
        least_hypotheses: that are refined, even if fewer are reported: the confidence depends on
            rivals. Of 15 photographs of another object, 14 were called reliable with one
            hypothesis, 2 with two, none with three or five.
        start_angle, start_roll: degrees by which a pose is rotated left, right, up and down, and
            about the line of sight, for further starts: about half the spacing of a bank's views.
        far_angle: degrees of more starts of a pose that is fitted again.
        wide_angles: degrees of more starts of poses that are refined: they may be worse than views
            of a bank.
        kept_starts: starts of a pose that continue after the first round.
        finished_fits: hypotheses of a photograph whose contours are fitted at full size.
        close_score: by which rivals may be behind to be compared with the best pose in detail.
        close_rivals: how many of them are fitted as thoroughly.
        same_pose_angle: degrees within which two fitted hypotheses count as one.
        min_keypoints: that must agree on a pose to make it a start.
        kept_keypoints: fraction of the keypoints that agree with a start, which must agree with its
            fit as well.
        chance_keypoints: that agree with a wrong pose by chance: on generated shelves, 96 % of
            wrong hypotheses have no more.
        weights: what each kind of evidence counts for in the score of a pose.
        lost_confidence: confidence of a refinement below which the object counts as lost, see
            docs/guides/known-pose.md.
        reliable: confidence from which an answer is called reliable.

    Raises:
        InvalidInputError: a number out of range.

    Example:
        >>> replace(Pipeline(), fit=FitSettings(screened_views=15)).describe()["fit"]["start_angle"]
        8.0
    """

    screened_views: int = 10
    screening_weight: float = 20.0
    least_hypotheses: int = 3
    start_angle: float = 8.0
    start_roll: float = 6.0
    far_angle: float = 16.0
    wide_angles: tuple[float, ...] = (14.0, 22.0)
    kept_starts: int = 3
    finished_fits: int = 2
    close_score: float = 2.5
    close_rivals: int = 2
    same_pose_angle: float = 15.0
    min_keypoints: int = 8
    kept_keypoints: float = 0.5
    chance_keypoints: int = 2
    weights: EvidenceWeights = EvidenceWeights()
    lost_confidence: float = 0.35
    reliable: float = 0.9

    def __post_init__(self) -> None:
        angles = tuple(check_positive(angle, "fit: wide_angles") for angle in self.wide_angles)
        object.__setattr__(self, "wide_angles", angles)
        counts = ("screened_views", "least_hypotheses", "kept_starts", "finished_fits")
        _convert_integers(self, counts, prefix="fit: ")
        _convert_integers(self, ("min_keypoints",), prefix="fit: ", least=4)
        _convert_integers(self, ("close_rivals", "chance_keypoints"), prefix="fit: ", least=0)
        for name in ("start_angle", "start_roll", "far_angle", "same_pose_angle"):
            check_positive(getattr(self, name), f"fit: {name}")
        for name in ("screening_weight", "close_score"):
            check_positive(getattr(self, name), f"fit: {name}", zero_ok=True)
        for name in ("kept_keypoints", "lost_confidence", "reliable"):
            check_probability(getattr(self, name), f"fit: {name}")


@dataclass(frozen=True)
class Pipeline:
    """From a photograph, a box and a mesh to a pose: all settings, as plain numbers and strings.

    Attributes:
        views: which viewpoints are rendered.
        bank: how views and photographs are described.
        field: filter of photographs: a name in ``FIELDS``, or "custom:NAME" for a module that
            is passed with each call.
        weights: digest of the field's weights; "" for a field without any. Filled in for packaged
            weights.
        terms: ranking terms, each at most once.
        box_jitter: error that boxes are allowed, as a fraction of their longer side in [0, 0.45];
            0: exact boxes.
        box_is: "whole": boxes are those of the whole object. "visible": those of its visible part,
            and an occluder may hide the rest.
        hypotheses: distinct views that are carried through search and contour fit.
        search: the paper's search between the coherent ones of the three best views, without
            contour fit.
        contours: fit the mesh's contours to the photograph's edges.
        detection: how boxes that are not given are found.
        fit: how views become poses, and poses an answer.

    Raises:
        InvalidInputError: an unknown name or a number out of range.

    Example:
        >>> Pipeline() == Pipeline.from_json(Pipeline().to_json())
        True
        >>> replace(Pipeline(), box_jitter=0.0).with_pose_prior("upright").views.pose
        'upright'
    """

    views: ViewPolicy = ViewPolicy()
    bank: BankSettings = BankSettings()
    field: str = "learned"
    weights: str = ""
    terms: tuple[Term, ...] = dataclass_field(
        default=(Correlation(), Repeatability(), BoxShape(), Appearance())
    )
    box_jitter: float = 0.1
    box_is: str = "whole"
    hypotheses: int = 5
    search: bool = False
    contours: bool = True
    detection: DetectionSettings = DetectionSettings()
    fit: FitSettings = FitSettings()

    def __post_init__(self) -> None:
        if not self.field.startswith(CUSTOM):
            check_option(self.field, FIELDS, "field")
        if self.field == "learned" and not self.weights:
            object.__setattr__(self, "weights", SHA256[:16])
        names = [term.name for term in self.terms]
        if len(set(names)) < len(names) or not any(
            t.name == Correlation.name and t.weight > 0 for t in self.terms
        ):
            message = (
                f"expected each term once, and {Correlation.name!r}, which all results are "
                f"scored "
                f"by, got {names}"
            )
            raise InvalidInputError(f"terms: {message}")
        _convert_integers(self, ("hypotheses",))
        if self.search and self.contours:
            raise InvalidInputError(
                "search: the paper's search takes the place of the contour fit; set contours=False"
            )
        check_box_jitter(self.box_jitter)
        check_option(self.box_is, BOX_KINDS, "box_is")

    def with_pose_prior(self, pose: str) -> "Pipeline":
        """A copy with another ``pose`` of the view policy."""
        return replace(self, views=replace(self.views, pose=pose))

    def with_boxes(self, box_is: str) -> "Pipeline":
        """A copy for boxes of another kind, see ``box_is``."""
        return replace(self, box_is=box_is)

    def with_term(self, name: str, **options: Any) -> "Pipeline":
        """A copy with other options of one term; ``weight=0`` removes the term from the product."""
        check_option(name, [term.name for term in self.terms], "term")
        return replace(
            self, terms=tuple(replace(t, **options) if t.name == name else t for t in self.terms)
        )

    def with_field(self, field: nn.Module) -> "Pipeline":
        """A copy that records a custom module as the photograph's field, by class name and
        digest."""
        if not isinstance(field, nn.Module):
            raise InvalidInputError(
                f"field: expected a module such as ImageGradient(), got {field!r:.60}"
            )
        return replace(self, field=f"{CUSTOM}{type(field).__name__}", weights=field_digest(field))

    def photograph_field(self) -> nn.Module:
        """The filter of photographs; refuses a custom field, and packaged weights of another
        digest."""
        if self.field.startswith(CUSTOM):
            raise InvalidInputError(
                f"field: {self.field!r} was passed by the caller; pass it again (field=...)"
            )
        if self.field == "learned" and self.weights != SHA256[:16]:
            raise InvalidInputError(
                f"field: expected weights {self.weights}, got packaged {SHA256[:16]}; pass the "
                f"module (field=...)"
            )
        # one that is trained is passed by the caller
        return FIELDS[self.field]().requires_grad_(False)

    def stored_appearance(self, count: int) -> Appearance | None:
        """The appearance term, if a bank of ``count`` views holds the features of all its views."""
        return next(
            (t for t in self.terms if isinstance(t, Appearance) and count <= t.exhaustive_limit),
            None,
        )

    def describe(self) -> dict[str, Any]:
        """All settings as plain numbers, strings, lists and dictionaries for JSON."""
        described = {
            "version": VERSION,
            **asdict(self),
            "terms": {term.name: asdict(term) for term in self.terms},
        }
        described["views"]["elevations"] = list(self.views.elevations)
        described["fit"]["wide_angles"] = list(self.fit.wide_angles)
        return described

    def to_json(self) -> str:
        return json.dumps(self.describe(), indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> "Pipeline":
        """Read what ``to_json`` wrote, or a part of it; what is missing keeps its default."""
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InvalidInputError(f"pipeline: not JSON ({error})") from error
        data = _object(data, "pipeline")
        if data.pop("version", VERSION) != VERSION:
            raise InvalidInputError(
                f"pipeline: this library reads version {VERSION}; write the file again"
            )
        return _settings(cls, data, "pipeline")

    @classmethod
    def read(cls, path: str | PathLike[str]) -> "Pipeline":
        """Read a JSON file, see :meth:`from_json`."""
        path = Path(path)
        if not path.is_file():
            raise MissingFileError(f"{path}: no such pipeline; write one with Pipeline().to_json()")
        try:
            return cls.from_json(path.read_text(encoding="utf-8-sig"))
        except (InvalidInputError, UnicodeDecodeError) as error:
            raise InvalidInputError(f"{path}: {error}") from error


def _object(data: Any, name: str) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise InvalidInputError(
            f"{name}: expected a JSON object, got {data!r}; compare with Pipeline().to_json()"
        )
    return dict(data)


def _settings(kind: type[Settings], data: Any, name: str) -> Settings:
    """A dataclass from a JSON object, whose values must have the types of the defaults."""
    defaults: Mapping[str, Any] = {f.name: getattr(kind(), f.name) for f in fields(kind)}  # type: ignore[arg-type]
    values = _object(data, name)
    for key, value in values.items():
        if key not in defaults:
            raise InvalidInputError(
                f"{name}: unknown key {key!r}; expected one of {', '.join(defaults)}"
            )
        default = defaults[key]
        path = f"{name}: {key}"
        if is_dataclass(default):
            values[key] = _settings(type(default), value, path)
        elif key == "terms":
            options = _object(value, path)
            for term in options:
                check_option(term, TERMS, "term")
            values[key] = tuple(
                _settings(TERMS[term], given, f"{path}: {term}") for term, given in options.items()
            )
        elif not _fits(value, default):
            raise InvalidInputError(f"{path}: expected a value like {default!r}, got {value!r}")
    return kind(**values)


def _fits(value: Any, default: Any) -> bool:
    """Whether a value from JSON has the type of a default: a flag, a finite number, a text, or a
    list of numbers."""
    if isinstance(default, bool | str):
        return isinstance(value, type(default))
    if isinstance(default, tuple):
        return isinstance(value, list) and all(_fits(one, 0.0) for one in value)
    number = int if isinstance(default, int) else int | float
    return isinstance(value, number) and not isinstance(value, bool) and math.isfinite(value)


def field_digest(field: nn.Module) -> str:
    """16 hexadecimal digits of a module's parameters and buffers; "" for a module without any."""
    state = field.state_dict()
    return tensor_digest(state) if state else ""


_CLASSICAL_TERMS: tuple[Term, ...] = (Correlation(), Repeatability(), BoxShape())

PRESETS: dict[str, Pipeline] = {
    "learned": Pipeline(),
    "classical": Pipeline(field="focus", terms=_CLASSICAL_TERMS),
    "fast": Pipeline(terms=_CLASSICAL_TERMS, box_jitter=0.0, contours=False),
    "paper": Pipeline(
        views=ViewPolicy(pose="paper", frame="principal"),
        bank=BankSettings(formula="paper", camera="orthographic"),
        field="MFC",
        terms=(Correlation(whitening="paper"), Repeatability(mode="paper")),
        box_jitter=0.0,
        hypotheses=1,
        search=True,
        contours=False,
    ),
}
"""``learned``: :class:`LearnedCurvilinearSaliency` as the photograph's field, and the appearance
term; ``classical``: focus curves, nothing learned; ``fast``: the learned field alone, without box
jitter and contour fit; ``paper``: the paper to the letter, with none of our stages."""


def preset_named(name: str) -> Pipeline:
    """``PRESETS[name]``, or an :class:`InvalidInputError` that lists the presets."""
    check_option(name, list(PRESETS), "preset")
    return PRESETS[name]
