"""Everything that decides a result, in one frozen value: the only source of defaults."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from dataclasses import field as dataclass_field
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import nn

from .errors import InvalidInputError, MissingFileError
from .features.learned_field import SHA256
from .settings import BankSettings, LocateSettings, ViewPolicy
from .terms import TERMS, Appearance, BoxShape, Correlation, Repeatability, RerankingTerm, Term, jittered_boxes
from .utils.checks import check_option
from .utils.choices import DEFAULT
from .utils.files import tensor_digest
from .utils.registry import Registry

__all__ = ["DEFAULT", "FIELDS", "PRESETS", "Pipeline", "field_digest", "preset_named"]

VERSION = 1
"""Of the JSON form."""

FIELDS: Registry[Callable[[], nn.Module]] = Registry(
    "field",
    {
        "learned": "curvireg_torch.features:LearnedCurvilinearSaliency",
        "focus": "curvireg_torch.filters:MultiScaleFocusCurves",
        "saliency": "curvireg_torch.filters:MultiScaleCurvilinearSaliency",
        "gradient": "curvireg_torch.filters:ImageGradient",
    },
)
"""Photograph filters by name: modules that are built without arguments."""

CUSTOM = "custom:"
"""Prefix of the name of a field that is passed with each call."""


@dataclass(frozen=True)
class Pipeline:
    """From a photograph, a box and a mesh to a pose: all settings, as plain numbers and strings.

    Attributes:
        views: which viewpoints are rendered.
        bank: how views and photographs are described.
        field: filter of photographs: a name in :data:`FIELDS`, or "custom:NAME" for a module that is passed with each
            call.
        weights: digest of the field's weights; "" for a field without any. Filled in for packaged weights.
        terms: ranking terms, each at most once.
        box_jitter: error that boxes are allowed, as a fraction of their longer side (:func:`jittered_boxes`); 0: exact
            boxes.
        hypotheses: distinct views that are carried through search and contour fit.
        search: search around hypotheses in small rotation steps.
        contours: fit the mesh's contours to the photograph's edges.
        locate: how boxes that are not given are found.

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
    terms: tuple[Term, ...] = dataclass_field(default=(Correlation(), Repeatability(), BoxShape(), Appearance()))
    box_jitter: float = 0.1
    hypotheses: int = 5
    search: bool = True
    contours: bool = True
    locate: LocateSettings = LocateSettings()

    def __post_init__(self) -> None:
        if not self.field.startswith(CUSTOM):
            FIELDS.check(self.field)
        if self.field == "learned" and not self.weights:
            object.__setattr__(self, "weights", SHA256[:16])
        names = [term.name for term in self.terms]
        if len(set(names)) < len(names) or all(isinstance(term, RerankingTerm) for term in self.terms):
            raise InvalidInputError(f"terms: expected one or more that compare all views, each once, got {names}")
        if self.hypotheses < 1:
            raise InvalidInputError(f"hypotheses: expected >= 1, got {self.hypotheses}")
        jittered_boxes(torch.ones(0, 4), self.box_jitter)  # checks box_jitter

    def with_pose_prior(self, pose: str) -> "Pipeline":
        """A copy with another ``pose`` of the view policy."""
        return replace(self, views=replace(self.views, pose=pose))

    def with_term(self, name: str, **options: Any) -> "Pipeline":
        """A copy with other options of one term; ``weight=0`` removes the term from the product.

        Example:
            >>> Pipeline().with_term("box", weight=0).terms[2].weight
            0
        """
        check_option(name, [term.name for term in self.terms], "term")
        return replace(self, terms=tuple(replace(t, **options) if t.name == name else t for t in self.terms))

    def with_field(self, field: nn.Module) -> "Pipeline":
        """A copy that records a custom module as the photograph's field, by class name and digest."""
        return replace(self, field=f"{CUSTOM}{type(field).__name__}", weights=field_digest(field))

    def photograph_field(self) -> nn.Module:
        """The filter of photographs; refuses a custom field, and packaged weights of another digest."""
        if self.field.startswith(CUSTOM):
            raise InvalidInputError(f"field: {self.field!r} was passed by the caller; pass it again (field=...)")
        if self.field == "learned" and self.weights != SHA256[:16]:
            raise InvalidInputError(
                f"field: expected weights {self.weights}, got packaged {SHA256[:16]}; pass the module (field=...)"
            )
        return FIELDS[self.field]()

    def reranking_terms(self, count: int) -> list[RerankingTerm]:
        """The reranking terms whose features a bank of ``count`` views holds for every view."""
        return [term for term in self.terms if isinstance(term, RerankingTerm) and count <= term.exhaustive_limit]

    def bank_key_fields(self, count: int) -> dict[str, Any]:
        """What decides the contents of a bank of ``count`` views, besides mesh and viewpoints."""
        return {**asdict(self.bank), "reranking": [term.name for term in self.reranking_terms(count)]}

    def describe(self) -> dict[str, Any]:
        """All settings as plain numbers, strings, lists and dictionaries for JSON."""
        described = {"version": VERSION, **asdict(self), "terms": {term.name: asdict(term) for term in self.terms}}
        described["views"]["elevations"] = list(self.views.elevations)
        return described

    def to_json(self) -> str:
        return json.dumps(self.describe(), indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> "Pipeline":
        """Read what :meth:`to_json` wrote, or a part of it; what is missing keeps its default."""
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InvalidInputError(f"pipeline: not JSON ({error})") from error
        if not isinstance(data, dict):
            raise InvalidInputError(f"pipeline: expected a JSON object, got {type(data).__name__}")
        if data.pop("version", VERSION) != VERSION:
            raise InvalidInputError(f"pipeline: this library reads version {VERSION}; write the file again")
        for name in ("views", "bank", "locate", "terms"):
            if not isinstance(data.get(name, {}), dict):
                raise InvalidInputError(f"pipeline: {name}: expected a JSON object; compare with Pipeline().to_json()")
        try:
            for name, settings in (("views", ViewPolicy), ("bank", BankSettings), ("locate", LocateSettings)):
                if name in data:
                    data[name] = settings(**data[name])
            if "terms" in data:
                data["terms"] = tuple(TERMS[name](**options) for name, options in data["terms"].items())
            return cls(**data)
        except (TypeError, AttributeError) as error:
            raise InvalidInputError(f"pipeline: {error}; compare with Pipeline().to_json()") from error

    @classmethod
    def read(cls, path: str | PathLike[str]) -> "Pipeline":
        """Read a JSON file, see :meth:`from_json`."""
        path = Path(path)
        if not path.is_file():
            raise MissingFileError(f"{path}: no such pipeline; write one with Pipeline().to_json()")
        try:
            return cls.from_json(path.read_text(encoding="utf-8"))
        except (InvalidInputError, UnicodeDecodeError) as error:
            raise InvalidInputError(f"{path}: {error}") from error


def field_digest(field: nn.Module) -> str:
    """16 hexadecimal digits of a module's parameters and buffers; "" for a module without any."""
    state = field.state_dict()
    return tensor_digest(state) if state else ""


_CLASSICAL_TERMS: tuple[Term, ...] = (Correlation(), Repeatability(), BoxShape())

PRESETS: dict[str, Pipeline] = {
    "learned": Pipeline(),
    "classical": Pipeline(field="focus", terms=_CLASSICAL_TERMS),
    "fast": Pipeline(terms=_CLASSICAL_TERMS, box_jitter=0.0, search=False, contours=False),
    "paper": Pipeline(
        bank=BankSettings(image_size=256, sigma=1.0, formula="paper", camera="orthographic"),
        field="focus",
        terms=(Correlation(whitening="bank"), Repeatability(mode="paper"), BoxShape(weight=0.0)),
        box_jitter=0.0,
    ),
}
"""``learned``: :class:`LearnedCurvilinearSaliency` as the photograph's field, and the appearance term; ``classical``:
focus curves, nothing learned; ``fast``: the learned field alone, without box jitter, search and contour fit; ``paper``:
the paper's own settings, as far as it states them."""


def preset_named(name: str) -> Pipeline:
    """``PRESETS[name]``, or an :class:`InvalidInputError` that lists the presets."""
    check_option(name, list(PRESETS), "preset")
    return PRESETS[name]
