"""What is computed for an object: one table, looked up by name."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from dataclasses import field as dataclass_field
from typing import Any

from torch import nn

from .errors import InvalidInputError
from .filters import MultiScaleFocusCurves
from .geometry import ViewSphere, sample_views, uniform_views
from .learned import LearnedCurvilinearSaliency
from .matching import BankSettings

__all__ = ["FIELDS", "PRESETS", "Preset", "preset_named"]

FIELDS: dict[str, Callable[[], nn.Module]] = {
    "focus": MultiScaleFocusCurves,
    "learned": LearnedCurvilinearSaliency,
}
"""Photograph filters by name."""


@dataclass(frozen=True)
class Preset:
    """Settings of banks and of the search.

    Attributes:
        bank: of every view bank.
        field: name of the photograph filter, one of ``FIELDS``.
        refine: search around the best views of the bank.

    Example:
        >>> len(Preset().views("upright"))
        288
    """

    bank: BankSettings = dataclass_field(default_factory=lambda: BankSettings(image_size=128, sigma=0.8))
    field: str = "focus"
    refine: bool = True

    def photograph_filter(self) -> nn.Module:
        """What makes fields of photographs."""
        return FIELDS[self.field]()

    def views(self, pose: str) -> ViewSphere:
        """The bank's viewpoints: for objects that stand upright, or for any orientation."""
        return sample_views() if pose == "upright" else uniform_views(300, thetas=range(0, 360, 15))

    def describe(self) -> dict[str, Any]:
        """Everything that decides a result, as plain numbers and texts."""
        return {**asdict(self.bank), "field": self.field, "refine": self.refine}


PRESETS = {"default": Preset(), "learned": Preset(field="learned")}


def preset_named(name: str) -> Preset:
    """The preset of that name.

    Raises:
        InvalidInputError: there is none.
    """
    if name not in PRESETS:
        raise InvalidInputError(f"preset: expected one of {', '.join(map(repr, PRESETS))}, got {name!r}")
    return PRESETS[name]
