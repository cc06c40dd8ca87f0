"""All views of a bank ranked for every photograph of a batch."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from kornia.color import rgb_to_grayscale
from torch import Tensor, nn

from .._checks import check_option, check_positive
from ..descriptors import field_points
from ..errors import InvalidInputError
from ..filters import MultiScaleFocusCurves
from ..geometry.crops import crop_images
from .bank import ViewBank
from .collection import BankCollection
from .repeatability import MODES, dilate_points, repeatability, repeatability_score
from .similarity import normalized_correlation, unit_score

__all__ = ["QueryFeatures", "Ranking", "ViewMatcher"]


@dataclass(frozen=True)
class Ranking:
    """Scores of N views for B photographs.

    Attributes:
        scores: (B, N) in [0, 1], S = S_hog . S_rep.
        order: (B, N) view indices, best first; ties in the order of the bank.
        hog: (B, N) normalised correlation of descriptors, in [0, 1].
        repeatability: (B, N) share of the photograph's points found in the view.
    """

    scores: Tensor
    order: Tensor
    hog: Tensor
    repeatability: Tensor

    def __len__(self) -> int:
        return self.scores.shape[0]

    def __getitem__(self, index: slice) -> "Ranking":
        return Ranking(self.scores[index], self.order[index], self.hog[index], self.repeatability[index])

    def top(self, k: int) -> Tensor:
        """(B, k) indices of the best views; fewer where the bank is smaller."""
        return self.order[:, :k]


@dataclass(frozen=True)
class QueryFeatures:
    """What is compared of B photographs.

    Attributes:
        field: (B, 2, S, S).
        descriptors: (B, D).
        points: (B, S, S) bool.
    """

    field: Tensor
    descriptors: Tensor
    points: Tensor

    def __getitem__(self, index: slice) -> "QueryFeatures":
        return QueryFeatures(self.field[index], self.descriptors[index], self.points[index])


class ViewMatcher(nn.Module):
    """Ranks all views of a bank for every photograph.

    The box of each photograph is cropped as the views are, turned into a field, described by the bank's HOG, and
    compared with all views: S_hog (normalised correlation, mapped to (0, 1] by :func:`unit_score`) times S_rep
    (:func:`repeatability_score`).

    Args:
        bank: the views of one model, or of several (which one is it?).
        field: photograph filter (B, 1, S, S) -> (B, 2, S, S); default :class:`MultiScaleFocusCurves`. One with an
            attribute ``colour = True`` gets colour photographs as (B, 3, S, S).
        eps: distance in px of the crop within which points repeat; default 2 % of its side.
        repeatability_mode: "monotone" or "paper".
        chunk_size: photographs in memory at a time.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box(), sample_views(azimuth_step=90), image_size=64, progress=False)
        >>> ranking = ViewMatcher(bank)(torch.rand(2, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30], [10, 5, 60, 47]]))
        >>> ranking.scores.shape, ranking.top(3).shape
        (torch.Size([2, 32]), torch.Size([2, 3]))
    """

    def __init__(
        self,
        bank: ViewBank | BankCollection,
        *,
        field: nn.Module | None = None,
        eps: float | None = None,
        repeatability_mode: str = "monotone",
        chunk_size: int = 16,
    ) -> None:
        super().__init__()
        check_option(repeatability_mode, MODES, "repeatability_mode")
        if chunk_size < 1:
            raise InvalidInputError(f"chunk_size: expected >= 1, got {chunk_size}")
        self.bank = bank
        self.field = MultiScaleFocusCurves() if field is None else field
        self.eps = 0.02 * bank.settings.image_size if eps is None else eps
        check_positive(self.eps, "eps", zero_ok=True)
        self.repeatability_mode = repeatability_mode
        self.chunk_size = chunk_size
        self.descriptor = bank.settings.descriptor()
        # Points are counted in cells of eps px or less, so that the product stays small.
        self._cell = max(1, min(int(self.eps), bank.settings.image_size // 64))
        cells = [
            self._in_cells(dilate_points(bank.points_at(slice(i, i + 64)), self.eps)[:, None].float())
            for i in range(0, len(bank), 64)
        ]
        self._view_points: Tensor
        self.register_buffer("_view_points", torch.cat(cells), persistent=False)

    def _in_cells(self, points: Tensor) -> Tensor:
        """(N, C, C) share of each cell's pixels that are set, from (N, 1, S, S)."""
        return F.avg_pool2d(points, self._cell, ceil_mode=True)[:, 0]

    def crop(self, images: Tensor | Sequence[Tensor], boxes: Tensor) -> tuple[Tensor, Tensor]:
        """(B, C, S, S) crops and (B, 3, 3) crop transforms, cut as the bank's views are."""
        settings = self.bank.settings
        return crop_images(images, boxes, size=settings.image_size, margin=settings.margin)

    def forward(self, images: Tensor | Sequence[Tensor], boxes: Tensor) -> Ranking:
        """Rank all views.

        Args:
            images: (B, C, H, W) or a list of (C, H, W), C = 1 or 3, in [0, 1].
            boxes: (B, 4) x0, y0, x1, y1 in px.

        Raises:
            InvalidInputError: wrong shape, dtype, device, or an unusable box.
        """
        parts = [
            self.rank(self.features(self.crop(images[i : i + self.chunk_size], boxes[i : i + self.chunk_size])[0]))
            for i in range(0, max(1, len(images)), self.chunk_size)
        ]
        return Ranking(
            *(torch.cat([getattr(p, n) for p in parts]) for n in ("scores", "order", "hog", "repeatability"))
        )

    def features(self, crops: Tensor) -> QueryFeatures:
        """Describe (B, 1 or 3, S, S) crops that :meth:`crop` cut."""
        if crops.shape[1] not in (1, 3):
            raise InvalidInputError(f"images: expected 1 (grey) or 3 (RGB) channels, got {crops.shape[1]}")
        grey = crops.shape[1] == 3 and not getattr(self.field, "colour", False)
        field: Tensor = self.field(rgb_to_grayscale(crops) if grey else crops)
        points = field_points(field, share=self.bank.settings.point_share)[:, 0]
        return QueryFeatures(field, self.descriptor(field), points)

    def rank(self, query: QueryFeatures) -> Ranking:
        """Compare described photographs with all views."""
        hog = normalized_correlation(query.descriptors, self.bank.descriptors)
        rep = repeatability(self._in_cells(query.points[:, None].float()), self._view_points)
        scores = unit_score(hog) * repeatability_score(rep, mode=self.repeatability_mode)
        return Ranking(scores, scores.argsort(dim=1, descending=True, stable=True), hog, rep)
