"""What is computed for an object: one table, looked up by name."""

from dataclasses import asdict, dataclass, field
from typing import Any

from ..errors import InvalidInputError
from ..geometry import ViewSphere, sample_views, uniform_views
from ..matching import BankSettings

__all__ = ["PRESETS", "Preset", "preset_named"]


@dataclass(frozen=True)
class Preset:
    """Settings of banks and of the search.

    Attributes:
        bank: of every view bank.
        refine: search around the best views of the bank.

    Example:
        >>> len(Preset().views("upright"))
        288
    """

    bank: BankSettings = field(default_factory=lambda: BankSettings(image_size=128, sigma=0.8))
    refine: bool = True

    def views(self, pose: str) -> ViewSphere:
        """The bank's viewpoints: for objects that stand upright, or for any orientation."""
        return sample_views() if pose == "upright" else uniform_views(300, thetas=range(0, 360, 15))

    def describe(self) -> dict[str, Any]:
        """Everything that decides a result, as plain numbers and texts."""
        return {**asdict(self.bank), "refine": self.refine}


PRESETS = {"default": Preset()}


def preset_named(name: str) -> Preset:
    """The preset of that name.

    Raises:
        InvalidInputError: there is none.
    """
    if name not in PRESETS:
        raise InvalidInputError(f"preset: expected one of {', '.join(map(repr, PRESETS))}, got {name!r}")
    return PRESETS[name]
