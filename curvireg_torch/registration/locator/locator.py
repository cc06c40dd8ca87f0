"""Boxes in which a photograph resembles one of a bank's views."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...errors import InvalidInputError
from ...geometry.crops import crop_transforms, non_maximum_suppression, square_boxes
from ...geometry.pose_prior import check_distance
from ...matching import ViewBank, ViewDescriber, ViewMatcher
from ...pipeline import Pipeline
from ...utils.checks import as_numbers, check_camera_matrix, check_photograph, check_pixels, check_square_pixels
from .dense_features import DenseFeatures, dense_features_for
from .representatives import nearest_representatives, representative_views

__all__ = ["OVERLAP", "Located", "Locator", "locate"]

SIDE = 96
"""Side of the template views in px."""

STEP = 2.0**0.5
"""Factor between successive sizes of the object."""

OVERLAP = 0.5
"""Intersection over union from which boxes show the same object."""

LEAST = 32.0
"""Longer side in px of the smallest object that can be recognised."""

PEAKS = 500
"""Best peaks of a photograph that boxes are selected from."""


@dataclass(frozen=True)
class Located:
    """Boxes of one photograph, best first.

    Attributes:
        boxes: (P, 4) x0, y0, x1, y1 in px, of the whole object: they may extend beyond the image.
        scores: (P,) similarity, in standard deviations above the view's mean over the photograph.
        views: (P,) int64 view of the bank.
    """

    boxes: Tensor
    scores: Tensor
    views: Tensor


@dataclass(frozen=True)
class _Templates:
    """K views of a bank, and their weights (K, C, h, w) for each stride and each shading.

    ``boxes`` (K, 4) are in px of the templates, from the outer border; at the distances ``unit`` (K,) a camera with a
    focal length of 1 px sees the object at this size.
    """

    views: Tensor
    weights: list[list[Tensor]]
    boxes: Tensor
    unit: Tensor


class Locator(nn.Module):
    r"""Searches whole photographs for a bank's objects, in place of a detector.

    A few representative views (:func:`representative_views`) are compared with every position of the photograph, at
    sizes in steps of :math:`\sqrt 2`. A view's similarity is the mean cosine of its dense features
    (:class:`.DenseFeatures`) and the photograph's over the cells that it covers; its score is the similarity in
    standard deviations above its mean over the photograph. Peaks over position, size and view are boxes.

    Args:
        matcher: of the bank; ``locate`` of its pipeline holds the settings. For an example see :func:`locate`.
    """

    def __init__(self, matcher: ViewMatcher) -> None:
        super().__init__()
        self.matcher, self.settings = matcher, matcher.pipeline.locate
        self.features = dense_features_for(matcher)
        self._templates = _templates(self.features, matcher, self.settings.views)

    @cached_property
    def _template_of_view(self) -> Tensor:
        """(N,) template that stands for each view of the bank."""
        return nearest_representatives(self.matcher.bank, self._templates.views)

    @torch.no_grad()
    def forward(
        self,
        images: Tensor | Sequence[Tensor],
        *,
        camera_matrices: Sequence[Tensor | None] | None = None,
        distance: tuple[float, float] | None = None,
        allowed: Tensor | None = None,
    ) -> list[Located]:
        """Boxes of each photograph, independent of the others.

        Args:
            images: (B, C, H, W) or a list of (C, H, W), C = 1 or 3, floating in [0, 1] or uint8.
            camera_matrices: (3, 3) of each in px, for ``distance``.
            distance: range of the distance of the object's centre, in the mesh's unit.
            allowed: (N,) bool; views that stand for none of these views of the bank are not compared.

        Raises:
            InvalidInputError: wrong shape or dtype, or a ``distance`` without cameras or not 0 < NEAR <= FAR.
            ImageError: missing pixels (NaN or infinite), or pixels outside [0, 1].
        """
        check_distance(distance)
        if distance is not None and (camera_matrices is None or any(K is None for K in camera_matrices)):
            raise InvalidInputError("distance: needs the camera matrix of every photograph")
        out = []
        for i, image in enumerate(images):
            K = None if camera_matrices is None else camera_matrices[i]
            if K is not None:
                K = as_numbers(K, "camera_matrices", dtype=torch.float64)
                check_camera_matrix(K)
                check_square_pixels(K)
            out.append(self._locate(image, None if K is None else float(K[0, 0]), distance, allowed))
        return out

    def _locate(
        self, image: Tensor, focal: float | None, distance: tuple[float, float] | None, views: Tensor | None
    ) -> Located:
        check_photograph(image)
        templates = self._templates
        usable = torch.ones(len(templates.views), dtype=torch.bool)
        if views is not None:
            usable = torch.zeros_like(usable).index_fill(0, self._template_of_view[views.cpu()], True)
        side = (templates.boxes[:, 2:] - templates.boxes[:, :2]).amax(dim=1)
        scales = self._scales(image, focal, distance, float(side.quantile(0.5)))
        maps, allowed, ratios = [], [], []
        largest: Tensor | None = None  # comes first; the smaller copies are resized from it
        for scale in scales:
            h, w = (max(1, round(s * scale / 16)) * 16 for s in image.shape[-2:])
            if largest is None:
                largest = _resized(image, (h, w)).to(self.matcher.device)
                check_pixels(largest, "of the photograph")  # on the resized copy, which missing pixels spread to
            maps.append(self._similarity(_resized(largest, (h, w))[None]))
            ratios.append((w / image.shape[-1], h / image.shape[-2]))
            fits = usable.to(side.device)
            if distance is not None and focal is not None:
                away = templates.unit * focal * scale
                fits = fits & (away >= distance[0] / STEP**0.5) & (away <= distance[1] * STEP**0.5)
            allowed.append(fits)
        if not maps:
            return Located(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, dtype=torch.long))
        return self._peaks(maps, allowed, ratios)

    def _scales(
        self, image: Tensor, focal: float | None, distance: tuple[float, float] | None, side: float
    ) -> list[float]:
        """Factors by which the photograph is resized, so that objects of all sizes match templates of ``side`` px."""
        longer = float(max(image.shape[-2:]))
        small, large = min(max(self.settings.min_size * longer, LEAST), longer), longer
        if focal is not None and distance is not None:
            extent = side * focal * self._templates.unit  # px at distance 1
            small = max(small, float(extent.min()) / distance[1])
            large = min(large, float(extent.max()) / distance[0])
        scales, size = [], small
        while size <= large * STEP**0.5:
            scales.append(side / size)
            size *= STEP
        return scales

    def _similarity(self, image: Tensor) -> Tensor:
        """(K, h, w) mean cosines; position (i, j) is that of a view whose centre is at px 8 i, 8 j."""
        cosines: list[Tensor] = []
        for cells, weights in zip(self.features.of_photograph(image), self._templates.weights, strict=True):
            cells = self.features.comparable(cells, cells.mean(dim=(0, 2, 3))[:, None, None])
            padded = F.pad(cells, (weights[0].shape[-1] // 2,) * 4)
            cosines.append(torch.stack([F.conv2d(padded, shading)[0] for shading in weights]).amax(dim=0))
        size = cosines[0].shape[1:]
        fine = [F.interpolate(c[None], size=size, mode="bilinear", align_corners=True)[0] for c in cosines[1:]]
        return sum(fine, cosines[0]) / len(cosines)

    def _peaks(self, maps: list[Tensor], allowed: list[Tensor], ratios: list[tuple[float, float]]) -> Located:
        templates = self._templates
        every = torch.cat([m.flatten(1) for m in maps], dim=1)
        mean, spread = every.mean(dim=1), every.std(dim=1).clamp(min=1e-6)
        boxes, scores, views = [], [], []
        for similarity, fits, ratio in zip(maps, allowed, ratios, strict=True):
            z = (similarity - mean[:, None, None]) / spread[:, None, None]
            best, view = z.masked_fill(~fits[:, None, None], -torch.inf).max(dim=0)
            peak = (best == F.max_pool2d(best[None], 3, stride=1, padding=1)[0]) & best.isfinite()
            i, j = peak.nonzero(as_tuple=True)
            corner = torch.stack([j, i], dim=1).repeat(1, 2) * 8.0 - SIDE / 2.0
            boxes.append((templates.boxes[view[i, j]] + corner) / best.new_tensor([*ratio, *ratio]) - 0.5)
            scores.append(best[i, j])
            views.append(templates.views[view[i, j].cpu()])
        score, index = torch.cat(scores).sort(descending=True, stable=True)
        index = index[:PEAKS]
        box, view = torch.cat(boxes)[index], torch.cat(views)[index.cpu()]
        kept = non_maximum_suppression(box, score[:PEAKS], OVERLAP)[: self.settings.proposals]
        return Located(box[kept].cpu(), score[kept].cpu(), view[kept.cpu()])


def _templates(features: DenseFeatures, matcher: ViewMatcher, count: int) -> _Templates:
    bank = matcher.bank
    views = representative_views(bank, count)
    R, z, boxes = bank.rotations[views], bank.distances[views], bank.boxes[views].double()
    masks = bank.silhouettes_at(views)[:, None].float()
    weights: list[list[Tensor]] = [[] for _ in features.strides]
    for maps in _by_model(matcher, views, lambda d, i: features.of_views(d, R[i], z[i], SIDE)):
        for stride, cells, templates in zip(features.strides, maps, weights, strict=True):
            mask = F.interpolate(masks, size=(SIDE // stride, SIDE // stride), mode="area")
            common = (cells * mask).sum(dim=(0, 2, 3)) / mask.sum()
            unit = features.comparable(cells, common[:, None, None]) * mask
            templates.append(unit / mask.sum(dim=(2, 3), keepdim=True).clamp(min=1e-6))
    A = crop_transforms(square_boxes(boxes, bank.settings.margin), SIDE)
    scale, shift = A[:, 0, 0, None], A[:, :2, 2]
    corners = boxes * scale + shift.repeat(1, 2) + 0.5
    away = torch.ones_like(z) if bank.settings.camera == "orthographic" else z
    return _Templates(views.cpu(), weights, corners.float(), (away.to(scale) / scale[:, 0]).float())


def _by_model(
    matcher: ViewMatcher, views: Tensor, of_views: Callable[[ViewDescriber, Tensor], list[list[Tensor]]]
) -> list[list[Tensor]]:
    """Results of ``of_views`` for each model, joined in the order of the views; all models have the same shadings."""
    model = matcher.bank.model[views]
    parts, index = [], []
    for m in model.unique().tolist():
        mine = (model == m).nonzero()[:, 0]
        parts.append(of_views(matcher.describers[m], mine))
        index.append(mine)
    back = torch.cat(index).argsort()
    return [[torch.cat(stride)[back] for stride in zip(*shading, strict=True)] for shading in zip(*parts, strict=True)]


def _resized(image: Tensor, size: tuple[int, int]) -> Tensor:
    """(C, h, w) float32 in [0, 1]."""
    if tuple(image.shape[-2:]) == size and image.is_floating_point():
        return image.float()
    options: dict[str, Any] = {"size": size, "mode": "bilinear", "antialias": True, "align_corners": False}
    # One channel at a time to save memory: photographs are large.
    small = torch.cat([F.interpolate(channel[None, None].float(), **options)[0] for channel in image])
    return small / 255.0 if image.dtype == torch.uint8 else small


def locate(
    pipeline: Pipeline,
    bank: ViewBank,
    images: Tensor | Sequence[Tensor],
    *,
    camera_matrices: Sequence[Tensor | None] | None = None,
    distance: tuple[float, float] | None = None,
) -> tuple[Tensor, Tensor]:
    """Boxes in which photographs may show a bank's object; for many calls, :class:`Locator` is faster.

    Arguments and errors are those of :meth:`Locator.forward`; ``pipeline.locate`` holds the settings.

    Returns:
        boxes (B, P, 4) x0, y0, x1, y1 in px, and scores (B, P), best first; NaN and -inf where there are fewer than P.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45, elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> boxes, scores = locate(bank.pipeline, bank, [torch.rand(3, 96, 128)])
        >>> boxes.shape[:2] == scores.shape
        True
    """
    located = Locator(ViewMatcher(bank, pipeline=pipeline))(images, camera_matrices=camera_matrices, distance=distance)
    most = max((len(one.scores) for one in located), default=0)
    boxes = torch.full((len(located), most, 4), torch.nan)
    scores = torch.full((len(located), most), -torch.inf)
    for b, one in enumerate(located):
        boxes[b, : len(one.boxes)], scores[b, : len(one.scores)] = one.boxes, one.scores
    return boxes, scores
