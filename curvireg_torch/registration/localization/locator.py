"""Boxes in which a photograph shows something like one of a bank's views."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from kornia.geometry.bbox import nms
from torch import Tensor, nn

from ...errors import InvalidInputError
from ...geometry.crops import crop_transforms, square_boxes
from ...matching import ViewBank, ViewDescriber, ViewMatcher
from ...pipeline import Pipeline
from ...utils.checks import as_numbers, check_camera_matrix, check_photograph, check_pixels, check_square_pixels
from .dense_features import DenseFeatures, dense_features_for
from .representatives import representative_views

__all__ = ["OVERLAP", "Located", "Locator", "check_distance", "locate"]

SIDE = 96
"""Of the views that are looked for, px."""

STEP = 2.0**0.5
"""From one size of the object to the next."""

OVERLAP = 0.5
"""Intersection over union of boxes that show the same."""

LEAST = 32.0
"""Px of the longer side of an object that can still be told from others."""

PEAKS = 500
"""Best places of a photograph among which boxes are chosen."""


@dataclass(frozen=True)
class Located:
    """Boxes of one photograph, best first.

    Attributes:
        boxes: (P, 4) x0, y0, x1, y1 in px, of the whole object: they may reach beyond the image.
        scores: (P,) by how many standard deviations a view agrees better there than elsewhere in the photograph.
        views: (P,) int64 of the bank, what was found there.
    """

    boxes: Tensor
    scores: Tensor
    views: Tensor


@dataclass(frozen=True)
class _Templates:
    """K views: (K, C, h, w) weights for each way to show them, for each stride; boxes (K, 4) in px of their pictures,
    from the outer border; ``unit`` (K,): how far away a camera of 1 px focal length sees the object as large."""

    views: Tensor
    weights: list[list[Tensor]]
    boxes: Tensor
    unit: Tensor


class Locator(nn.Module):
    r"""Looks for a bank's objects in whole photographs, in place of a detector.

    A few representative views (:func:`representative_views`) are compared with every place of the photograph at sizes
    in steps of :math:`\sqrt 2`: features of both (``location/cells.py``) lose what is common to the
    object, or to the photograph at that size, cells become unit vectors, and a view's raw score is the mean cosine of
    the cells that it covers, one convolution. What a view scores by is how far that lies above its scores elsewhere in
    the same photograph, in standard deviations. Peaks over place, size and view are boxes.

    Args:
        matcher: of the bank; its pipeline says how many views (``locate.views``), how small the object may be
            (``locate.min_size``) and how many boxes are proposed (``locate.proposals``).

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45, elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> found = Locator(ViewMatcher(bank))([torch.rand(3, 96, 128)])[0]
        >>> found.boxes.shape == (len(found.scores), 4)
        True
    """

    def __init__(self, matcher: ViewMatcher) -> None:
        super().__init__()
        self.matcher, self.settings = matcher, matcher.pipeline.locate
        self.cells = dense_features_for(matcher)
        self._templates = _templates(self.cells, matcher, self.settings.views)

    @torch.no_grad()
    def forward(
        self,
        images: Tensor | Sequence[Tensor],
        *,
        camera_matrices: Sequence[Tensor | None] | None = None,
        distance: tuple[float, float] | None = None,
    ) -> list[Located]:
        """Boxes of each photograph; one does not depend on the others.

        Args:
            images: (B, C, H, W) or a list of (C, H, W), C = 1 or 3, floating in [0, 1] or uint8.
            camera_matrices: (3, 3) of each in px, for ``distance``.
            distance: nearest and farthest that the object's centre may be, in the mesh's unit.

        Raises:
            InvalidInputError: wrong shape or dtype, an image of one px, or a ``distance`` without cameras or not
                0 < MIN <= MAX.
            ImageError: missing pixels (NaN or infinite), or pixels outside [0, 1].
        """
        known = camera_matrices is not None and all(K is not None for K in camera_matrices)
        check_distance(distance, with_cameras=known)
        out = []
        for i, image in enumerate(images):
            K = None if camera_matrices is None else camera_matrices[i]
            if K is not None:
                K = as_numbers(K, "camera_matrices", least=torch.float64)
                check_camera_matrix(K)
                check_square_pixels(K)
            focal = None if K is None else float(K[0, 0])
            out.append(self._one(image, focal, distance))
        return out

    def _one(self, image: Tensor, focal: float | None, distance: tuple[float, float] | None) -> Located:
        check_photograph(image)
        known = self._templates
        reach = (known.boxes[:, 2:] - known.boxes[:, :2]).amax(dim=1)
        scales = self._scales(image, focal, distance, float(reach.quantile(0.5)))
        maps, allowed, sizes = [], [], []
        largest: Tensor | None = None  # and first: the others are made of it
        for scale in scales:
            h, w = (max(1, round(side * scale / 16)) * 16 for side in image.shape[-2:])
            if largest is None:
                largest = _resized(image, (h, w)).to(self.matcher.device)
                check_pixels(largest, "of the photograph")  # the few of the small copy: what is missing spreads to them
            maps.append(self._agreement(_resized(largest, (h, w))[None]))
            sizes.append((w / image.shape[-1], h / image.shape[-2]))
            fits = torch.ones_like(reach, dtype=torch.bool)
            if distance is not None and focal is not None:
                away = known.unit * focal * scale  # what this size means
                fits = (away >= distance[0] / STEP**0.5) & (away <= distance[1] * STEP**0.5)
            allowed.append(fits)
        if not maps:
            return Located(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, dtype=torch.long))
        return self._peaks(maps, allowed, sizes)

    def _scales(
        self, image: Tensor, focal: float | None, distance: tuple[float, float] | None, reach: float
    ) -> list[float]:
        """Factors by which the photograph is resized, so that objects of all sizes become as large as the views."""
        longer = float(max(image.shape[-2:]))
        small, large = min(max(self.settings.min_size * longer, LEAST), longer), longer
        if focal is not None and distance is not None:
            extent = reach * focal * self._templates.unit  # px at distance 1
            small = max(small, float(extent.min()) / distance[1])
            large = min(large, float(extent.max()) / distance[0])
        scales, side = [], small
        while side <= large * STEP**0.5:
            scales.append(reach / side)
            side *= STEP
        return scales

    def _agreement(self, image: Tensor) -> Tensor:
        """(K, h, w) mean cosines; place (i, j) is that of a view whose middle lies at px 8 i, 8 j."""
        out = None
        features = self.cells.of_photograph(image)
        for n, (feature, ways) in enumerate(zip(features, self._templates.weights, strict=True)):
            cells = self.cells.comparable(feature, feature.mean(dim=(0, 2, 3))[:, None, None])
            pad = ways[0].shape[-1] // 2
            padded = F.pad(cells, (pad, pad, pad, pad))
            found = torch.stack([F.conv2d(padded, way)[0] for way in ways]).amax(dim=0)
            if out is None:
                out = found
            else:
                fine = F.interpolate(found[None], size=out.shape[1:], mode="bilinear", align_corners=True)[0]
                out = (out * n + fine) / (n + 1)
        assert out is not None
        return out

    def _peaks(self, maps: list[Tensor], allowed: list[Tensor], sizes: list[tuple[float, float]]) -> Located:
        known = self._templates
        every = torch.cat([m.flatten(1) for m in maps], dim=1)
        mean, spread = every.mean(dim=1), every.std(dim=1).clamp(min=1e-6)
        boxes, scores, views = [], [], []
        for found, fits, ratio in zip(maps, allowed, sizes, strict=True):
            z = ((found - mean[:, None, None]) / spread[:, None, None]).masked_fill(~fits[:, None, None], -torch.inf)
            best, view = z.max(dim=0)
            peak = (best == F.max_pool2d(best[None], 3, stride=1, padding=1)[0]) & best.isfinite()
            i, j = peak.nonzero(as_tuple=True)
            place = torch.stack([j, i], dim=1).repeat(1, 2) * 8.0 - SIDE / 2.0
            boxes.append((known.boxes[view[i, j]] + place) / best.new_tensor([*ratio, *ratio]) - 0.5)
            scores.append(best[i, j])
            views.append(known.views[view[i, j].cpu()])
        score, index = torch.cat(scores).sort(descending=True, stable=True)
        index = index[:PEAKS]
        box, view = torch.cat(boxes)[index], torch.cat(views)[index.cpu()]
        kept = nms(box, score[:PEAKS], OVERLAP)[: self.settings.proposals]
        return Located(box[kept].cpu(), score[kept].cpu(), view[kept.cpu()])


def check_distance(distance: tuple[float, float] | None, *, with_cameras: bool) -> None:
    """Raise :class:`InvalidInputError` for distances that are not 0 < MIN <= MAX, or that come without cameras."""
    if distance is None:
        return
    low, high = distance
    if not 0.0 < low <= high < float("inf"):
        raise InvalidInputError(f"distance: expected 0 < MIN <= MAX, got {low:g} {high:g}")
    if not with_cameras:
        raise InvalidInputError("distance: needs the camera matrix of every photograph")


def _templates(cells: DenseFeatures, matcher: ViewMatcher, count: int) -> _Templates:
    bank = matcher.bank
    views = representative_views(bank, count)
    R, z, boxes = bank.rotations[views], bank.distances[views], bank.boxes[views].double()
    masks = bank.silhouettes_at(views)[:, None].float()
    weights: list[list[Tensor]] = [[] for _ in cells.strides]
    for ways in _by_model(matcher, views, lambda d, i: cells.of_views(d, R[i], z[i], SIDE)):
        for stride, feature, kept in zip(cells.strides, ways, weights, strict=True):
            mask = F.interpolate(masks, size=(SIDE // stride, SIDE // stride), mode="area")
            common = (feature * mask).sum(dim=(0, 2, 3)) / mask.sum()
            unit = cells.comparable(feature, common[:, None, None]) * mask
            kept.append(unit / mask.sum(dim=(2, 3), keepdim=True).clamp(min=1e-6))
    A = crop_transforms(square_boxes(boxes, bank.settings.margin), SIDE)
    scale, shift = A[:, 0, 0, None], A[:, :2, 2]
    corners = boxes * scale + shift.repeat(1, 2) + 0.5
    away = torch.ones_like(z) if bank.settings.camera == "orthographic" else z
    return _Templates(views.cpu(), weights, corners.float(), (away.to(scale) / scale[:, 0]).float())


def _by_model(
    matcher: ViewMatcher, views: Tensor, of_views: Callable[[ViewDescriber, Tensor], list[list[Tensor]]]
) -> list[list[Tensor]]:
    """What ``of_views`` says of each model's views, put together in the order of the views."""
    model = matcher.bank.model[views]
    parts, index = [], []
    for m in model.unique().tolist():
        mine = (model == m).nonzero()[:, 0]
        parts.append(of_views(matcher.describers[m], mine))
        index.append(mine)
    back = torch.cat(index).argsort()
    return [
        [torch.cat(stride)[back] for stride in zip(*way, strict=True)]
        for way in zip(*parts, strict=True)  # all models are shown in the same ways
    ]


def _resized(image: Tensor, size: tuple[int, int]) -> Tensor:
    """(C, h, w) float32 in [0, 1]."""
    if tuple(image.shape[-2:]) == size and image.is_floating_point():
        return image.float()
    channels = [  # one at a time: photographs are large
        F.interpolate(channel[None, None].float(), size=size, mode="bilinear", antialias=True, align_corners=False)[0]
        for channel in image
    ]
    small = torch.cat(channels)
    return small / 255.0 if image.dtype == torch.uint8 else small


def locate(
    pipeline: Pipeline,
    bank: ViewBank,
    images: Tensor | Sequence[Tensor],
    *,
    camera_matrices: Sequence[Tensor | None] | None = None,
    distance: tuple[float, float] | None = None,
) -> tuple[Tensor, Tensor]:
    """Boxes in which photographs may show a bank's object, see :class:`Locator`, which is quicker for many calls.

    Args:
        pipeline: its ``locate`` says how hard is looked.
        bank: of one or several models.
        images, camera_matrices, distance: see :meth:`Locator.forward`.

    Returns:
        boxes (B, P, 4) x0, y0, x1, y1 in px, and scores (B, P), best first; NaN and -inf where a photograph has fewer
        than P.

    Raises:
        InvalidInputError: see :meth:`Locator.forward`.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45, elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> boxes, scores = locate(bank.pipeline, bank, [torch.rand(3, 96, 128)])
        >>> boxes.shape[:2] == scores.shape
        True
    """
    locator = Locator(ViewMatcher(bank, pipeline=pipeline))
    found = locator(images, camera_matrices=camera_matrices, distance=distance)
    most = max((len(one.scores) for one in found), default=0)
    boxes = torch.full((len(found), most, 4), torch.nan)
    scores = torch.full((len(found), most), -torch.inf)
    for b, one in enumerate(found):
        boxes[b, : len(one.boxes)], scores[b, : len(one.scores)] = one.boxes, one.scores
    return boxes, scores
