"""What is computed for an object: one table, looked up by name."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from dataclasses import field as dataclass_field
from typing import Any

from torch import nn

from .errors import InvalidInputError
from .filters import ImageGradient, MultiScaleCurvilinearSaliency, MultiScaleFocusCurves
from .geometry import ViewSphere, sample_views, uniform_views
from .learned import LearnedCurvilinearSaliency
from .learned.network import SHA256
from .matching import BankSettings, DescriptorStatistics, ViewBank, ViewMatcher
from .registration import Registrar

__all__ = ["DEFAULT", "FIELDS", "PRESETS", "Preset", "preset_named"]

FIELDS: dict[str, Callable[[], nn.Module]] = {
    "learned": LearnedCurvilinearSaliency,
    "focus": MultiScaleFocusCurves,
    "saliency": MultiScaleCurvilinearSaliency,
    "gradient": ImageGradient,
}
"""Photograph filters by name."""


@dataclass(frozen=True)
class Preset:
    """Settings of banks, of the ranking and of the search.

    Attributes:
        bank: of every view bank.
        field: name of the photograph filter, one of ``FIELDS``.
        matcher: further options of :class:`ViewMatcher`.
        whitened: whiten descriptors by the statistics of the bank, shrunk by Ledoit-Wolf, as the paper does.
        refine: search around the best views of the bank, and follow the contours.

    Example:
        >>> len(Preset().views("upright"))
        288
    """

    bank: BankSettings = dataclass_field(default_factory=lambda: BankSettings(image_size=128, sigma=0.8))
    field: str = "learned"
    matcher: Mapping[str, Any] = dataclass_field(default_factory=dict)
    whitened: bool = False
    refine: bool = True

    def photograph_filter(self) -> nn.Module:
        """What makes fields of photographs."""
        return FIELDS[self.field]()

    def views(self, pose: str) -> ViewSphere:
        """The bank's viewpoints: for objects that stand upright, or for any orientation."""
        return sample_views() if pose == "upright" else uniform_views(300, thetas=range(0, 360, 15))

    def registrar(self, bank: ViewBank, *, field: nn.Module | None = None, **options: Any) -> Registrar:
        """A registrar as this preset wants it.

        Args:
            bank: made with ``self.bank``.
            field: default :meth:`photograph_filter`.
            options: of :class:`Registrar`.
        """
        statistics = DescriptorStatistics.from_bank(bank) if self.whitened else None
        whitening = None if statistics is None else statistics.whitening(shrinkage="ledoit-wolf")
        matcher = ViewMatcher(bank, field=field or self.photograph_filter(), whitening=whitening, **self.matcher)
        return Registrar(matcher, **{"refine": self.refine, **options})

    def describe(self) -> dict[str, Any]:
        """Everything that decides a result, as plain numbers and texts."""
        own = {"field": self.field, **self.matcher, "whitened": self.whitened, "refine": self.refine}
        weights = {"weights_sha256": SHA256[:16]} if self.field == "learned" else {}
        return {**asdict(self.bank), **own, **weights}


_PAPER = BankSettings(image_size=256, sigma=1.0, formula="paper", camera="orthographic")

PRESETS = {
    "learned": Preset(),
    "classical": Preset(field="focus"),
    "fast": Preset(matcher={"slack": 0.0}, refine=False),
    "paper": Preset(
        bank=_PAPER,
        field="focus",
        matcher={"repeatability_mode": "paper", "box_sigma": None, "slack": 0.0},
        whitened=True,
    ),
}
"""``learned``: the photograph's field by :class:`LearnedCurvilinearSaliency`; ``classical``: by focus curves, nothing
learnt; ``fast``: ``learned`` without slack and refinement; ``paper``: the paper's own, as far as it is stated."""

DEFAULT = "learned"


def preset_named(name: str) -> Preset:
    """The preset of that name.

    Raises:
        InvalidInputError: there is none.
    """
    if name not in PRESETS:
        raise InvalidInputError(f"preset: expected one of {', '.join(map(repr, PRESETS))}, got {name!r}")
    return PRESETS[name]
