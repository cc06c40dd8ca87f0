"""Dense features of whole photographs and of views, which the locator compares."""

from abc import ABC, abstractmethod

import torch.nn.functional as F
from torch import Tensor, nn

from ...features import orientation_cells
from ...features.backbone import STRIDES, Backbone
from ...matching import ViewDescriber, ViewMatcher
from ...terms import photograph_field

__all__ = ["BackboneFeatures", "DenseFeatures", "dense_features_for"]

FLAT = 0.01
"""Fraction of the strongest edges' energy below which a cell counts as without edges."""


class DenseFeatures(nn.Module, ABC):
    """Feature maps at one stride, or at two, the second twice the first.

    Attributes:
        strides: px of a cell.
        learned: whether a network computes them.
    """

    strides: tuple[int, ...]
    learned: bool

    def comparable(self, cells: Tensor, common: Tensor) -> Tensor:
        """(B, C, h, w) unit features without what they have in common: (C, 1, 1) means over photograph or object."""
        return F.normalize(cells - common, dim=1)

    @abstractmethod
    def of_photograph(self, image: Tensor) -> list[Tensor]:
        """(1, C, H / stride, W / stride) for each stride, of a (1, 1 or 3, H, W) image in [0, 1]."""

    @abstractmethod
    def of_views(self, describer: ViewDescriber, rotations: Tensor, distances: Tensor, side: int) -> list[list[Tensor]]:
        """(K, C, side / stride, side / stride) for each shading of K views of a mesh and each stride."""


class BackboneFeatures(DenseFeatures):
    """Features of the appearance term's network. Views are shaded grey, and in colour where the mesh has colours."""

    strides = STRIDES
    learned = True

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone = backbone

    def of_photograph(self, image: Tensor) -> list[Tensor]:
        return [f / s[:, None, None] for f, s in zip(self.backbone(image), self.backbone.spreads, strict=True)]

    def of_views(self, describer: ViewDescriber, rotations: Tensor, distances: Tensor, side: int) -> list[list[Tensor]]:
        pictures = describer.shaded(rotations, distances)
        small = F.interpolate(pictures, size=(side, side), mode="bilinear", antialias=True, align_corners=False)
        return [self.of_photograph(shaded) for shaded in (small[:, :1], small[:, 1:]) if shaded.shape[1]]


class FieldFeatures(DenseFeatures):
    """Orientation histograms of the photograph's field and of depth fields, for classical pipelines."""

    strides = (8,)
    learned = False

    def __init__(self, field: nn.Module) -> None:
        super().__init__()
        self.field = field

    def comparable(self, cells: Tensor, common: Tensor) -> Tensor:
        """Divided by the norm of the surrounding cells, as blocks of HOG are; cells without edges are near 0."""
        around = F.avg_pool2d(cells.square().sum(dim=1, keepdim=True), 3, stride=1, padding=1)
        return cells / (around + FLAT * around.amax(dim=(2, 3), keepdim=True)).clamp(min=1e-12).sqrt()

    def of_photograph(self, image: Tensor) -> list[Tensor]:
        H, W = image.shape[-2:]
        return [orientation_cells(photograph_field(self.field, image), grid=(H // 8, W // 8))]

    def of_views(self, describer: ViewDescriber, rotations: Tensor, distances: Tensor, side: int) -> list[list[Tensor]]:
        return [[orientation_cells(describer.fields(rotations, distances), grid=(side // 8, side // 8))]]


def dense_features_for(matcher: ViewMatcher) -> DenseFeatures:
    """Features of the backbone, or of fields for pipelines without anything learned."""
    pipeline = matcher.pipeline
    if pipeline.field == "learned" or any(term.name == "appearance" for term in pipeline.terms):
        networks = (module for module in matcher.modules() if isinstance(module, Backbone))
        return BackboneFeatures(next(networks, None) or Backbone()).to(matcher.device)
    return FieldFeatures(matcher.field).to(matcher.device)
