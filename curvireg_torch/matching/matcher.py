"""All views of a bank ranked for every photograph of a batch."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .._checks import check_option, check_positive
from ..descriptors import field_points
from ..errors import InvalidInputError
from ..filters import MultiScaleFocusCurves
from ..geometry.crops import crop_images
from .bank import ViewBank
from .box_shape import box_shape_score, box_shapes, whole_box_shapes
from .collection import BankCollection
from .query import QueryFeatures, crop_regions, photograph_field, slack_boxes
from .repeatability import MODES, dilate_points, repeatability, repeatability_score
from .similarity import unit_score
from .whitening import Whitening

__all__ = ["Ranking", "ViewMatcher"]


@dataclass(frozen=True)
class Ranking:
    """Scores of N views for B photographs.

    Attributes:
        scores: (B, N) in [0, 1], S = S_hog . S_rep . S_box.
        order: (B, N) view indices, best first; ties in the order of the bank.
        hog: (B, N) normalised correlation of descriptors: in [0, 1], or in [-1, 1] if they are whitened.
        repeatability: (B, N) share of the photograph's points found in the view.
        box: (B, N) S_box in [0, 1], likeness of the boxes' proportions, best view 1.
    """

    scores: Tensor
    order: Tensor
    hog: Tensor
    repeatability: Tensor
    box: Tensor

    def __len__(self) -> int:
        return self.scores.shape[0]

    def __getitem__(self, index: slice) -> "Ranking":
        return Ranking(*(getattr(self, field.name)[index] for field in fields(self)))

    def top(self, k: int) -> Tensor:
        """(B, k) indices of the best views; fewer where the bank is smaller."""
        return self.order[:, :k]


class ViewMatcher(nn.Module):
    """Ranks all views of a bank for every photograph.

    The box of each photograph is cropped as the views are, turned into a field, described by the bank's HOG, and
    compared with all views: S_hog (normalised correlation, mapped to (0, 1] by :func:`unit_score`) times S_rep
    (:func:`repeatability_score`) times S_box (:func:`box_shape_score`; 1 for a box that reaches the image's border).
    A box is never exact: correlation and repeatability are the best over a few crops that are moved and scaled a
    little.

    Args:
        bank: the views of one model, or of several (which one is it?).
        field: photograph filter (B, 1, S, S) -> (B, 2, S, S); default :class:`MultiScaleFocusCurves`. One with an
            attribute ``colour = True`` gets colour photographs as (B, 3, S, S).
        eps: distance in px of the crop within which points repeat; default 2 % of its side.
        repeatability_mode: "monotone" or "paper".
        repeatability_sigma, box_sigma: widths of S_rep and S_box; None leaves that factor out.
        slack: how wrong boxes may be, as a share of their longer side (:func:`slack_boxes`); 0 takes them as they are
            and costs a seventh of the work.
        whitening: compare whitened descriptors (:class:`DescriptorStatistics`); default plain ones.
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
        repeatability_sigma: float | None = 0.1,
        box_sigma: float | None = 0.2,
        slack: float = 0.1,
        whitening: Whitening | None = None,
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
        slack_boxes(torch.ones(0, 4), slack)  # says what is wrong with it
        self.repeatability_mode, self.slack, self.chunk_size = repeatability_mode, slack, chunk_size
        self.repeatability_sigma, self.box_sigma, self.whitening = repeatability_sigma, box_sigma, whitening
        self.descriptor = bank.settings.descriptor()
        # Points are counted in cells of eps px or less, so that the product stays small.
        self._cell = max(1, min(int(self.eps), bank.settings.image_size // 64))
        cells = [
            self._in_cells(dilate_points(bank.points_at(slice(i, i + 64)), self.eps)[:, None].float())
            for i in range(0, len(bank), 64)
        ]
        self._views: Tensor
        self._view_points: Tensor
        self._view_shapes: Tensor
        self.register_buffer("_views", self._comparable(bank.descriptors), persistent=False)
        self.register_buffer("_view_points", torch.cat(cells).flatten(1), persistent=False)
        self.register_buffer("_view_shapes", box_shapes(bank.boxes).float(), persistent=False)

    def _comparable(self, descriptors: Tensor) -> Tensor:
        """(N, D) descriptors whose inner products are the similarity."""
        whitened = descriptors if self.whitening is None else self.whitening(descriptors)
        return F.normalize(whitened, dim=1)

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
            self.rank(self.query(images[i : i + self.chunk_size], boxes[i : i + self.chunk_size]))
            for i in range(0, max(1, len(images)), self.chunk_size)
        ]
        return Ranking(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Ranking)))

    def query(self, images: Tensor | Sequence[Tensor], boxes: Tensor) -> QueryFeatures:
        """Crop and describe photographs, see :meth:`forward`."""
        settings = self.bank.settings
        boxes = boxes.float() if isinstance(boxes, Tensor) and not boxes.is_floating_point() else boxes
        several = slack_boxes(boxes, self.slack)
        crops = crop_regions(images, several, size=settings.image_size, margin=settings.margin)
        shapes = whole_box_shapes(boxes, [(int(image.shape[-2]), int(image.shape[-1])) for image in images])
        return self._describe(crops, shapes.to(crops))

    def features(self, crops: Tensor) -> QueryFeatures:
        """Describe (B, 1 or 3, S, S) crops that :meth:`crop` cut: boxes taken as they are, their shapes unknown."""
        return self._describe(crops[:, None], torch.full_like(crops[:, 0, 0, 0], torch.nan))

    def _describe(self, crops: Tensor, shapes: Tensor) -> QueryFeatures:
        B, K = crops.shape[:2]
        field = photograph_field(self.field, crops.flatten(0, 1))
        points = field_points(field, share=self.bank.settings.point_share)[:, 0]
        return QueryFeatures(
            crops=crops[:, 0],
            field=field.unflatten(0, (B, K))[:, 0],
            descriptors=self.descriptor(field).unflatten(0, (B, K)),
            points=self._in_cells(points[:, None].float()).unflatten(0, (B, K)),
            shapes=shapes,
        )

    def rank(self, query: QueryFeatures) -> Ranking:
        """Compare described photographs with all views."""
        K = query.descriptors.shape[1]
        queries = self._comparable(query.descriptors.flatten(0, 1)).to(self._views.dtype)
        hog = (queries @ self._views.T).float().view(-1, K, len(self._views)).amax(dim=1)
        rep = (
            repeatability(query.points.flatten(0, 1).flatten(1), self._view_points)
            .view(-1, K, len(self._views))
            .amax(dim=1)
        )
        box = torch.ones_like(hog)
        if self.box_sigma is not None:
            box = box_shape_score(query.shapes.float(), self._view_shapes, sigma=self.box_sigma)
        scores = unit_score(hog) * box
        if self.repeatability_sigma is not None:
            scores = scores * repeatability_score(rep, mode=self.repeatability_mode, sigma=self.repeatability_sigma)
        return Ranking(scores, scores.argsort(dim=1, descending=True, stable=True), hog, rep, box)
