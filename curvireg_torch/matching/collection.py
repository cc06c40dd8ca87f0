"""Banks of several models, ranked as one: which model fits a photograph best?"""

from collections.abc import Sequence
from dataclasses import fields

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..geometry.views import ViewSphere
from .bank import ViewBank

__all__ = ["BankCollection"]


class BankCollection:
    """The views of several banks, one after the other, as a :class:`ViewMatcher` reads them.

    Args:
        banks: at least one, all with the same settings and on one device; kept as they are.

    Attributes:
        banks: the banks.
        settings: of all of them.
        descriptors, boxes, rotations, views: as of :class:`ViewBank`, for all N views together.

    Raises:
        InvalidInputError: no bank, or settings or devices that differ.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> views = sample_views(azimuth_step=90, elevations=[20])
        >>> meshes = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 3))
        >>> both = BankCollection([ViewBank.build(m, views, image_size=64, progress=False) for m in meshes])
        >>> len(both), both.locate(5)
        (8, (1, 1))
    """

    def __init__(self, banks: Sequence[ViewBank]) -> None:
        if not banks:
            raise InvalidInputError("banks: expected at least one bank, got none")
        self.banks = tuple(banks)
        self.settings = self.banks[0].settings
        for i, bank in enumerate(self.banks):
            if bank.settings != self.settings:
                raise InvalidInputError(
                    f"banks: expected one set of settings, but bank {i} has {bank.settings} and bank 0 {self.settings}"
                )
            if bank.device != self.device:
                raise InvalidInputError(
                    f"banks: expected one device, but bank {i} is on {bank.device}, not {self.device}"
                )
        self.descriptors = torch.cat([bank.descriptors for bank in self.banks])
        self.boxes = torch.cat([bank.boxes for bank in self.banks])
        self.views = ViewSphere(
            *(torch.cat([getattr(bank.views, field.name) for bank in self.banks]) for field in fields(ViewSphere))
        )
        self._starts = [0]
        for bank in self.banks:
            self._starts.append(self._starts[-1] + len(bank))

    def __len__(self) -> int:
        return self._starts[-1]

    @property
    def device(self) -> torch.device:
        return self.banks[0].device

    @property
    def rotations(self) -> Tensor:
        """(N, 3, 3) rotations model -> camera, each in its own model's frame."""
        return self.views.rotations.to(self.device)

    @property
    def points(self) -> Tensor:
        """(N, S, S) bool feature points of the views."""
        return self.points_at(slice(None))

    @property
    def silhouettes(self) -> Tensor:
        """(N, S, S) bool: pixels that show the object."""
        return self.silhouettes_at(slice(None))

    def points_at(self, index: Tensor | slice) -> Tensor:
        """(K, S, S) bool feature points of some views."""
        return self._gather(index, "points_at")

    def silhouettes_at(self, index: Tensor | slice) -> Tensor:
        """(K, S, S) bool silhouettes of some views."""
        return self._gather(index, "silhouettes_at")

    def locate(self, index: int) -> tuple[int, int]:
        """Number of the bank, and of the view in it, of one of the N views."""
        if not 0 <= index < len(self):
            raise InvalidInputError(f"index: expected 0 <= index < {len(self)}, got {index}")
        bank = next(i for i in range(len(self.banks)) if index < self._starts[i + 1])
        return bank, index - self._starts[bank]

    def _gather(self, index: Tensor | slice, name: str) -> Tensor:
        chosen = torch.arange(len(self), device=self.device)[index]
        S = self.settings.image_size
        out = torch.zeros(len(chosen), S, S, dtype=torch.bool, device=self.device)
        for bank, start in zip(self.banks, self._starts, strict=False):
            mine = (chosen >= start) & (chosen < start + len(bank))
            if bool(mine.any()):
                out[mine] = getattr(bank, name)(chosen[mine] - start)
        return out
