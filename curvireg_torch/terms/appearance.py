"""Similarity of backbone features of the photograph and of shaded views."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..features.appearance import describe, similarity
from ..features.backbone import SHA256, Backbone
from .base import RerankingModule, RerankingTerm, Views
from .query import QueryFeatures

__all__ = ["Appearance"]


@dataclass(frozen=True)
class Appearance(RerankingTerm):
    """S_look: features of an ImageNet network agree, cell by cell, between the photograph's crop and the shaded view.

    A mesh with colours is rendered twice, in grey and in its colours, and the better match counts for each view: a
    print distinguishes top from bottom, and the grey picture remains where the print misleads. Raw scores are mean
    cosines (:func:`curvireg_torch.features.appearance.similarity`) in [-1, 1]; log S_look = (raw - max raw) / std raw,
    over the compared views.

    Attributes:
        weights: digest of the network's weights.
    """

    name: ClassVar[str] = "appearance"
    weight: float = 2.0
    weights: str = SHA256[:16]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.weights != SHA256[:16]:
            raise InvalidInputError(f"appearance: expected weights {self.weights}, got installed weights {SHA256[:16]}")

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

    def describe(self, pictures: Tensor) -> Tensor:
        grey, colour = pictures[:, :1], pictures[:, 1:]
        features = [describe(picture, self.backbone) for picture in (grey, colour) if picture.shape[1]]
        return torch.cat(features, dim=1)

    def compare(self, query: QueryFeatures, features: Tensor) -> Tensor:
        if Appearance.name not in query.reranking_features:  # shared by ranking and rescoring
            query.reranking_features[Appearance.name] = describe(query.crops, self.backbone)
        crops = query.reranking_features[Appearance.name]
        similarities = similarity(crops[:, None], features.reshape(-1, crops.shape[1]))
        return similarities.view(len(crops), len(features), -1).amax(dim=2)
