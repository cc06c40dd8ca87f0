"""Local features of whole photographs and of views, on grids of cells: what a search for objects compares."""

from abc import ABC, abstractmethod

import torch.nn.functional as F
from torch import Tensor, nn

from ...descriptors import orientation_cells
from ...matching import ViewDescriber, ViewMatcher
from ...models.backbone import STRIDES, Backbone
from ...terms import photograph_field

__all__ = ["BackboneFeatures", "DenseFeatures", "FieldFeatures", "dense_features_for"]


FLAT = 0.01
"""Share of the strongest edges' energy that counts as none."""


class DenseFeatures(nn.Module, ABC):
    """Feature maps at one stride, or at two, the second twice as coarse.

    Attributes:
        strides: px of a cell.
        pictures: whether a network looked at them; how alike fields are hardly tells an object from what is beside it.
    """

    strides: tuple[int, ...]
    pictures: bool

    def comparable(self, cells: Tensor, common: Tensor) -> Tensor:
        """(B, C, h, w) of the same, so that inner products tell how alike cells are.

        Args:
            cells: of :meth:`of_photograph` or :meth:`of_views`.
            common: (C, 1, 1) mean of the photograph at that size, or of the object in its views.
        """
        return F.normalize(cells - common, dim=1)

    @abstractmethod
    def of_photograph(self, image: Tensor) -> list[Tensor]:
        """(1, C, H / stride, W / stride) for each stride, of a (1, 1 or 3, H, W) image in [0, 1]."""

    @abstractmethod
    def of_views(self, describer: ViewDescriber, rotations: Tensor, distances: Tensor, side: int) -> list[list[Tensor]]:
        """(K, C, side / stride, side / stride) for each stride, for each way to show K views of a mesh."""


class BackboneFeatures(DenseFeatures):
    """Features of the appearance term's network. Views are shaded grey, and in colours where the mesh has some."""

    strides = STRIDES
    pictures = True

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone = backbone

    def of_photograph(self, image: Tensor) -> list[Tensor]:
        return [f / s[:, None, None] for f, s in zip(self.backbone(image), self.backbone.spreads, strict=True)]

    def of_views(self, describer: ViewDescriber, rotations: Tensor, distances: Tensor, side: int) -> list[list[Tensor]]:
        pictures = describer.shaded(rotations, distances)
        small = F.interpolate(pictures, size=(side, side), mode="bilinear", antialias=True, align_corners=False)
        return [self.of_photograph(way) for way in (small[:, :1], small[:, 1:]) if way.shape[1]]


class FieldFeatures(DenseFeatures):
    """Orientations of the photograph's field and of depth fields, for pipelines in which nothing was learnt."""

    strides = (8,)
    pictures = False

    def __init__(self, field: nn.Module) -> None:
        super().__init__()
        self.field = field

    def comparable(self, cells: Tensor, common: Tensor) -> Tensor:
        """Divided by the length of the cells around, as blocks of HOG are: where there is no edge, nothing is alike."""
        around = F.avg_pool2d(cells.square().sum(dim=1, keepdim=True), 3, stride=1, padding=1)
        return cells / (around + FLAT * around.amax(dim=(2, 3), keepdim=True)).clamp(min=1e-12).sqrt()

    def of_photograph(self, image: Tensor) -> list[Tensor]:
        H, W = image.shape[-2:]
        (cell,) = self.strides
        return [orientation_cells(photograph_field(self.field, image), grid=(H // cell, W // cell))]

    def of_views(self, describer: ViewDescriber, rotations: Tensor, distances: Tensor, side: int) -> list[list[Tensor]]:
        (cell,) = self.strides
        return [[orientation_cells(describer.fields(rotations, distances), grid=(side // cell, side // cell))]]


def dense_features_for(matcher: ViewMatcher) -> DenseFeatures:
    """Pictures, as the appearance term's network sees them; fields for pipelines in which nothing was learnt."""
    pipeline = matcher.pipeline
    if pipeline.field == "learned" or any(term.name == "appearance" for term in pipeline.terms):
        networks = (module for module in matcher.modules() if isinstance(module, Backbone))
        return BackboneFeatures(next(networks, None) or Backbone()).to(matcher.device)
    return FieldFeatures(matcher.field).to(matcher.device)
