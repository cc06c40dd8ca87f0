"""Everything that decides a result, in one frozen value: the only source of defaults."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from dataclasses import field as dataclass_field
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import nn

from .errors import InvalidInputError, MissingFileError
from .filters import (
    ImageGradient,
    MultiScaleCurvilinearSaliency,
    MultiScaleFocusCurves,
)
from .settings import BankSettings, LocateSettings, ViewPolicy
from .terms import TERMS, Appearance, BoxShape, Correlation, Repeatability, RerankingTerm, Term, jittered_boxes
from .utils.checks import check_option
from .utils.choices import DEFAULT
from .utils.digests import tensor_digest

__all__ = [
    "DEFAULT",
    "FIELDS",
    "PRESETS",
    "Pipeline",
    "field_digest",
    "preset_named",
]

VERSION = 1
"""Of the JSON form."""

FIELDS = ("learned", "focus", "saliency", "gradient")
"""Photograph filters by name; "own:NAME" stands for a module that comes with the call."""


@dataclass(frozen=True)
class Pipeline:
    """From a photograph, a box and a mesh to a pose: all settings, as plain numbers and texts.

    Attributes:
        views: which viewpoints are rendered.
        bank: how views and photographs are described.
        field: what makes the photograph's field: one of :data:`FIELDS`, or "own:NAME" for a module given with the call.
        weights: digest of the field's weights; "" where there are none, and filled in for packaged ones.
        terms: ranking terms, one of a kind.
        box_jitter: how wrong boxes may be, as a fraction of their longer side (:func:`jittered_boxes`); 0: exact boxes.
        hypotheses: distinct views that are carried through search and contours.
        search: search around them in small steps.
        contours: pull the mesh's contours onto the photograph's edges.
        locate: how boxes are found that are not given.

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
        if not self.field.startswith("own:"):
            check_option(self.field, FIELDS, "field")
        if self.field == "learned" and not self.weights:
            from .models.learned_field import SHA256

            object.__setattr__(self, "weights", SHA256[:16])
        names = [term.name for term in self.terms]
        if len(set(names)) < len(names) or all(isinstance(term, RerankingTerm) for term in self.terms):
            raise InvalidInputError(f"terms: expected one or more that compare all views, each once, got {names}")
        if self.hypotheses < 1:
            raise InvalidInputError(f"hypotheses: expected >= 1, got {self.hypotheses}")
        jittered_boxes(torch.ones(0, 4), self.box_jitter)  # says what is wrong with it

    def with_pose_prior(self, pose: str) -> "Pipeline":
        """The same for another ``pose`` of the view policy."""
        return replace(self, views=replace(self.views, pose=pose))

    def with_term(self, name: str, **options: Any) -> "Pipeline":
        """The same with other options of one term; ``weight=0`` takes it out of the product.

        Example:
            >>> Pipeline().with_term("box", weight=0).terms[2].weight
            0
        """
        check_option(name, [term.name for term in self.terms], "term")
        return replace(self, terms=tuple(replace(t, **options) if t.name == name else t for t in self.terms))

    def photograph_field(self) -> nn.Module:
        """What makes fields of photographs.

        Raises:
            InvalidInputError: it came with the call, or the packaged weights are not those this pipeline was made with.
        """
        if self.field.startswith("own:"):
            raise InvalidInputError(f"field: {self.field!r} came with the call; give the module again (field=...)")
        if self.field == "learned":
            from .models.learned_field import SHA256, LearnedCurvilinearSaliency

            if self.weights != SHA256[:16]:
                raise InvalidInputError(
                    f"field: made with weights {self.weights}, packaged are {SHA256[:16]}; give the module (field=...)"
                )
            return LearnedCurvilinearSaliency()
        plain = {"focus": MultiScaleFocusCurves, "saliency": MultiScaleCurvilinearSaliency, "gradient": ImageGradient}
        made: nn.Module = plain[self.field]()
        return made

    def with_field(self, field: nn.Module) -> "Pipeline":
        """The same with a module of one's own as the photograph's field: its name and digest are noted."""
        return replace(self, field=f"own:{type(field).__name__}", weights=field_digest(field))

    def reranking_terms(self, count: int) -> list[RerankingTerm]:
        """The late terms by which all views of a bank of ``count`` are described."""
        return [term for term in self.terms if isinstance(term, RerankingTerm) and count <= term.coarse]

    def bank_key_fields(self, count: int) -> dict[str, Any]:
        """What decides the contents of a bank of ``count`` views, besides mesh and viewpoints."""
        return {**asdict(self.bank), "late": [term.name for term in self.reranking_terms(count)]}

    def describe(self) -> dict[str, Any]:
        """Plain numbers and texts, as JSON holds them."""
        terms = {term.name: {f.name: getattr(term, f.name) for f in fields(term)} for term in self.terms}
        own = {
            f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("views", "bank", "terms", "locate")
        }
        views = {**asdict(self.views), "elevations": list(self.views.elevations)}
        return {
            "version": VERSION,
            "views": views,
            "bank": asdict(self.bank),
            "terms": terms,
            **own,
            "locate": asdict(self.locate),
        }

    def to_json(self) -> str:
        """The pipeline as a JSON text, which :meth:`from_json` reads."""
        return json.dumps(self.describe(), indent=2) + "\n"

    @classmethod
    def from_json(cls, text: str) -> "Pipeline":
        """Read what :meth:`to_json` wrote, or part of it: what is not named keeps its default.

        Raises:
            InvalidInputError: not JSON, another version, an unknown name or a number out of range.
        """
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InvalidInputError(f"pipeline: not JSON ({error})") from error
        if not isinstance(data, dict):
            raise InvalidInputError(f"pipeline: expected a JSON object, got {type(data).__name__}")
        if data.pop("version", VERSION) != VERSION:
            raise InvalidInputError(f"pipeline: this library reads version {VERSION}; write the file again")
        try:
            if "views" in data:
                data["views"] = ViewPolicy(**data["views"])
            if "bank" in data:
                data["bank"] = BankSettings(**data["bank"])
            if "locate" in data:
                data["locate"] = LocateSettings(**data["locate"])
            if "terms" in data:
                data["terms"] = tuple(_term(name, options) for name, options in data["terms"].items())
            return cls(**data)
        except (TypeError, AttributeError) as error:
            raise InvalidInputError(f"pipeline: {error}; compare with Pipeline().to_json()") from error

    @classmethod
    def read(cls, path: str | PathLike[str]) -> "Pipeline":
        """From a JSON file.

        Raises:
            MissingFileError, InvalidInputError.
        """
        path = Path(path)
        if not path.is_file():
            raise MissingFileError(f"{path}: no such pipeline; write one with Pipeline().to_json()")
        try:
            return cls.from_json(path.read_text(encoding="utf-8"))
        except (InvalidInputError, UnicodeDecodeError) as error:
            raise InvalidInputError(f"{path}: {error}") from error


def field_digest(field: nn.Module) -> str:
    """16 hexadecimal digits of a module's parameters and buffers; "" of one that has none."""
    state = field.state_dict()
    return tensor_digest(state) if state else ""


def _term(name: str, options: Mapping[str, Any]) -> Term:
    check_option(name, list(TERMS), "term")
    return TERMS[name](**options)


_OWN: tuple[Term, ...] = (Correlation(), Repeatability(), BoxShape())
"""The paper's terms and the box: nothing that was learnt compares."""

_PAPER = BankSettings(image_size=256, sigma=1.0, formula="paper", camera="orthographic")

PRESETS: dict[str, Pipeline] = {
    "learned": Pipeline(),
    "classical": Pipeline(field="focus", terms=_OWN),
    "fast": Pipeline(terms=_OWN, box_jitter=0.0, search=False, contours=False),
    "paper": Pipeline(
        bank=_PAPER,
        field="focus",
        terms=(Correlation(whitening="bank"), Repeatability(mode="paper"), BoxShape(weight=0.0)),
        box_jitter=0.0,
    ),
}
"""``learned``: the photograph's field by :class:`LearnedCurvilinearSaliency`, and the appearance term; ``classical``:
by focus curves, nothing learnt; ``fast``: the learnt field alone, without slack, search and contours; ``paper``: the
paper's own, as far as it is stated."""


def preset_named(name: str) -> Pipeline:
    """The preset of that name.

    Raises:
        InvalidInputError: there is none.
    """
    check_option(name, list(PRESETS), "preset")
    return PRESETS[name]
