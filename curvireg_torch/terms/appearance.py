"""Does the photograph look as the shaded view does?"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..models.appearance import describe, similarity
from ..models.backbone import SHA256, Backbone
from .base import RerankingModule, RerankingTerm, Views
from .query import QueryFeatures

__all__ = ["Appearance"]


@dataclass(frozen=True)
class Appearance(RerankingTerm):
    """S_look: features of an ImageNet network agree, cell by cell, between the photograph's crop and the shaded view.

    A mesh with colours of its own is shown twice, shaded grey and in its colours, and what agrees better counts for
    each view: prints tell top from bottom, and where they mislead the grey picture is left. Raw scores are mean cosines
    (:func:`curvireg_torch.models.appearance.similarity`) in [-1, 1]; with the spread taken over the views that are
    compared, log S_look = (raw - max raw) / spread.

    Attributes:
        weights: digest of the network's.
    """

    name: ClassVar[str] = "appearance"
    weight: float = 2.0
    weights: str = SHA256[:16]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.weights != SHA256[:16]:
            raise InvalidInputError(f"appearance: made with weights {self.weights}, installed are {SHA256[:16]}")

    def build(self, views: Views | None) -> RerankingModule:
        return _AppearanceModule()

    def log_score(self, raw: Tensor) -> Tensor:
        spread = raw.std(dim=1, keepdim=True, correction=0)
        spread = torch.where(spread > 0, spread, torch.ones_like(spread))
        return (raw - raw.amax(dim=1, keepdim=True)) / spread


class _AppearanceModule(RerankingModule):
    def __init__(self) -> None:
        super().__init__()
        self.backbone = Backbone()

    def described(self, pictures: Tensor) -> Tensor:
        grey, colour = pictures[:, :1], pictures[:, 1:]
        ways = [describe(picture, self.backbone) for picture in (grey, colour) if picture.shape[1]]
        return torch.cat(ways, dim=1)

    def compare(self, photographs: QueryFeatures, views: Tensor) -> Tensor:
        if Appearance.name not in photographs.late:  # ranking and verdict ask about the same
            photographs.late[Appearance.name] = describe(photographs.crops, self.backbone)
        appearance_scores = photographs.late[Appearance.name]
        each = similarity(appearance_scores[:, None], views.reshape(-1, appearance_scores.shape[1]))
        return each.view(len(appearance_scores), len(views), -1).amax(dim=2)
