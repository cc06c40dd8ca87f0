"""Places in a photograph where an object may be: its views, compared at all places and sizes."""

from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..features.backbone import STRIDES, Backbone
from ..filters.operations import resized
from ..geometry.crops import crop_transforms, non_maximum_suppression, square_boxes
from ..geometry.pose_prior import check_distance
from ..utils.checks import check_photograph, check_pixels
from ..utils.rows import Rows
from . import ViewBank, ViewMatcher

TEMPLATE_SIDE = 96  # Side of the template views in px
SIZE_STEP = 2.0**0.5  # Factor between successive sizes of the object
SAME_OBJECT_OVERLAP = 0.5  # Intersection over union from which boxes show the same object
MIN_OBJECT_SIDE = 32.0  # Longer side in px of the smallest object that can be recognised
MAX_PEAKS = 500  # Best peaks of a photograph that boxes are selected from
# Largest number of views, evenly spread over the bank, whose pairwise distances are computed
MAX_COMPARED_VIEWS = 1500
MEDOID_ROUNDS = 10  # Largest number of rounds of k-medoids


@dataclass(frozen=True)
class Proposals(Rows):
    """Boxes of one photograph, best first.

    Attributes:
        boxes: (P, 4) x0, y0, x1, y1 in px, of the whole object: they may extend beyond the image.
        responses: (P,) similarity, in standard deviations above the view's mean over the
            photograph; of boxes that keypoints led to, the number of these.
        views: (P,) int64 view of the bank.
        by_keypoints: how many of the boxes keypoints led to, the first ones.

    Example:
        >>> box = torch.tensor([[0.0, 0.0, 9.0, 9.0]])
        >>> found = Proposals(box, torch.tensor([8.0]), torch.tensor([2]))
        >>> found.boxes.shape
        torch.Size([1, 4])
    """

    boxes: Tensor
    responses: Tensor
    views: Tensor
    by_keypoints: int = 0


class Detector(nn.Module):
    r"""Proposes boxes in which a photograph may show a bank's object.

    A few representative views are compared with every position of the photograph, at sizes in steps
    of :math:`\sqrt 2`. A view's similarity is the mean cosine of the backbone's features of view
    and photograph, in grey or in colour, over the cells that the view covers; its response is the
    similarity in standard deviations above its mean over the photograph. Peaks over position, size
    and view are boxes.

    Args:
        matcher: of the bank; ``detection`` of its pipeline holds the settings.

    Example:
        >>> import trimesh
        >>> from curvireg_torch.geometry import sample_views
        >>> bank = ViewBank.build(trimesh.creation.box((1, 2, 3)), sample_views(azimuth_step=45,
        ...     elevations=[20]),
        ...                       image_size=64, progress=False)
        >>> proposals = Detector(ViewMatcher(bank))(torch.rand(3, 96, 128))
        >>> proposals.boxes.shape[0] == len(proposals.responses)
        True
    """

    def __init__(self, matcher: ViewMatcher) -> None:
        super().__init__()
        self.matcher = matcher
        self.settings = matcher.pipeline.detection
        networks = (module for module in matcher.modules() if isinstance(module, Backbone))
        self.backbone = (next(networks, None) or Backbone()).to(matcher.bank.device)
        bank = matcher.bank
        self._views = _representative_views(bank, self.settings.views)
        boxes = bank.boxes[self._views].double()
        away = bank.distances[self._views]
        A = crop_transforms(square_boxes(boxes, bank.settings.margin), TEMPLATE_SIDE)
        scale = A[:, 0, 0, None]
        shift = A[:, :2, 2]
        # In px of the templates, from the outer border; and distances at which a focal length of 1
        # px shows this size.
        self._boxes = (boxes * scale + shift.repeat(1, 2) + 0.5).float()
        away = torch.ones_like(away) if bank.settings.camera == "orthographic" else away
        self._unit = (away.to(scale) / scale[:, 0]).float()
        self._weights = self._template_weights()

    def _template_weights(self) -> list[list[Tensor]]:
        """(K, C, h, w) for each stride and each shading."""
        bank = self.matcher.bank
        pictures = self.matcher.describer.shaded(
            bank.rotations[self._views], bank.distances[self._views]
        )
        masks = bank.silhouettes_at(self._views)[:, None].float()
        small = F.interpolate(
            pictures, (TEMPLATE_SIDE,) * 2, mode="bilinear", antialias=True, align_corners=False
        )
        weights: list[list[Tensor]] = [[] for _ in STRIDES]
        # Grey, and in colour where the mesh has colours.
        for shaded in (small[:, :1], small[:, 1:])[: 2 if small.shape[1] > 1 else 1]:
            for stride, cells, templates in zip(
                STRIDES, self._features(shaded), weights, strict=True
            ):
                mask = F.interpolate(masks, size=(TEMPLATE_SIDE // stride,) * 2, mode="area")
                common = (cells * mask).sum(dim=(0, 2, 3)) / mask.sum()
                unit = F.normalize(cells - common[:, None, None], dim=1) * mask
                templates.append(unit / mask.sum(dim=(2, 3), keepdim=True).clamp(min=1e-6))
        return weights

    def _features(self, image: Tensor) -> list[Tensor]:
        """(B, C, H / stride, W / stride) for each of ``STRIDES``, of (B, 1 or 3, H, W) images in
        [0, 1]."""
        return [
            f / s[:, None, None]
            for f, s in zip(self.backbone(image), self.backbone.spreads, strict=True)
        ]

    @cached_property
    def _template_of_view(self) -> Tensor:
        """(N,) template that is most similar to each view of the bank; on the CPU."""
        bank = self.matcher.bank
        views, chosen = (
            _view_features(bank, index) for index in (torch.arange(len(bank)), self._views)
        )
        return torch.cdist(views, chosen).argmin(dim=1).cpu()

    @torch.no_grad()
    def forward(
        self,
        image: Tensor,
        *,
        focal: float | None = None,
        distance: tuple[float, float] | None = None,
        allowed: Tensor | None = None,
    ) -> Proposals:
        """Boxes of a photograph (1 or 3, H, W), floating in [0, 1] or uint8.

        Args:
            focal: focal length in px, for ``distance``.
            distance: range of the distance of the object's centre, in the mesh's unit.
            allowed: (N,) bool; views that stand for none of these views of the bank are not
                compared.

        Raises:
            InvalidInputError: wrong shape or dtype, or a ``distance`` without ``focal`` or not 0 <
                NEAR <= FAR.
            ImageError: missing pixels (NaN or infinite), or pixels outside [0, 1].
        """
        check_photograph(image)
        check_distance(distance)
        if distance is not None and focal is None:
            raise InvalidInputError("distance: needs the camera matrix of every photograph")
        usable = torch.ones(len(self._views), dtype=torch.bool)
        if allowed is not None:
            usable = torch.zeros_like(usable).index_fill(
                0, self._template_of_view[allowed.cpu()], True
            )
        side = (self._boxes[:, 2:] - self._boxes[:, :2]).amax(dim=1)
        maps: list[Tensor] = []
        fitting = []
        ratios = []
        for scale in self._scales(image, focal, distance, float(side.quantile(0.5))):
            h, w = (max(1, round(s * scale / 16)) * 16 for s in image.shape[-2:])
            if not maps:  # the largest copy comes first; the smaller ones are resized from it
                largest = resized(image, (h, w)).to(self.matcher.bank.device)
                # on the resized copy, which missing pixels spread to
                check_pixels(largest, "of the photograph")
            maps.append(self._similarity(resized(largest, (h, w))[None]))
            ratios.append((w / image.shape[-1], h / image.shape[-2]))
            fits = usable.to(side.device)
            if distance is not None and focal is not None:
                away = self._unit * focal * scale
                fits = (
                    fits
                    & (away >= distance[0] / SIZE_STEP**0.5)
                    & (away <= distance[1] * SIZE_STEP**0.5)
                )
            fitting.append(fits)
        if not maps:
            return Proposals(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0, dtype=torch.long))
        return self._peaks(maps, fitting, ratios)

    def _scales(
        self, image: Tensor, focal: float | None, distance: tuple[float, float] | None, side: float
    ) -> list[float]:
        """Factors by which the photograph is resized, so that objects of all sizes match templates
        of ``side`` px."""
        longer = float(max(image.shape[-2:]))
        small = min(max(self.settings.min_size * longer, MIN_OBJECT_SIDE), longer)
        large = longer
        if focal is not None and distance is not None:
            extent = side * focal * self._unit  # px at distance 1
            small = max(small, float(extent.min()) / distance[1])
            large = min(large, float(extent.max()) / distance[0])
        scales = []
        size = small
        while size <= large * SIZE_STEP**0.5:
            scales.append(side / size)
            size *= SIZE_STEP
        return scales

    def _similarity(self, image: Tensor) -> Tensor:
        """(K, h, w) mean cosines; position (i, j) is that of a view whose centre is at px 8 i, 8
        j."""
        cosines: list[Tensor] = []
        for cells, weights in zip(self._features(image), self._weights, strict=True):
            cells = F.normalize(cells - cells.mean(dim=(0, 2, 3))[:, None, None], dim=1)
            padded = F.pad(cells, (weights[0].shape[-1] // 2,) * 4)
            cosines.append(
                torch.stack([F.conv2d(padded, shading)[0] for shading in weights]).amax(dim=0)
            )
        size = cosines[0].shape[1:]
        fine = [
            F.interpolate(c[None], size=size, mode="bilinear", align_corners=True)[0]
            for c in cosines[1:]
        ]
        return sum(fine, cosines[0]) / len(cosines)

    def _peaks(
        self, maps: list[Tensor], fitting: list[Tensor], ratios: list[tuple[float, float]]
    ) -> Proposals:
        every = torch.cat([m.flatten(1) for m in maps], dim=1)
        mean = every.mean(dim=1)
        spread = every.std(dim=1).clamp(min=1e-6)
        parts = []
        for similarity, fits, ratio in zip(maps, fitting, ratios, strict=True):
            z = (similarity - mean[:, None, None]) / spread[:, None, None]
            best, view = z.masked_fill(~fits[:, None, None], -torch.inf).max(dim=0)
            peak = (best == F.max_pool2d(best[None], 3, stride=1, padding=1)[0]) & best.isfinite()
            i, j = peak.nonzero(as_tuple=True)
            corner = torch.stack([j, i], dim=1).repeat(1, 2) * 8.0 - TEMPLATE_SIDE / 2.0
            box = (self._boxes[view[i, j]] + corner) / best.new_tensor([*ratio, *ratio]) - 0.5
            part = Proposals(box.cpu(), best[i, j].cpu(), self._views[view[i, j].cpu()])
            parts.append(part)
        found = Proposals.cat(parts)
        found = found[found.responses.argsort(descending=True, stable=True)[:MAX_PEAKS]]
        kept = non_maximum_suppression(found.boxes, found.responses, SAME_OBJECT_OVERLAP)
        return found[kept[: self.settings.proposals]]


def _representative_views(bank: ViewBank, count: int) -> Tensor:
    """(K,) k-medoids of a bank's views, ascending, on the CPU; all of a bank that has no more than
    ``count``. The distance of two views is the squared distance of their unit descriptors plus that
    of the logarithms of their boxes' aspect ratios. The first medoid is the most central view, each
    further one the farthest from those before."""
    views = torch.arange(len(bank))
    if len(views) > MAX_COMPARED_VIEWS:
        views = torch.arange(MAX_COMPARED_VIEWS) * len(bank) // MAX_COMPARED_VIEWS
    features = _view_features(bank, views)
    return views[_medoids(torch.cdist(features, features).square(), count).cpu()].sort().values


def _view_features(bank: ViewBank, views: Tensor) -> Tensor:
    sides = (bank.boxes[:, 2:] - bank.boxes[:, :2])[views]
    ratios = (sides[:, :1] / sides[:, 1:]).log().float()
    return torch.cat(
        [F.normalize(bank.descriptors[views].float(), dim=1), ratios.to(bank.descriptors.device)],
        dim=1,
    )


def _medoids(distances: Tensor, count: int) -> Tensor:
    """(min(count, N),) indices for (N, N) distances."""
    medoids = distances.sum(dim=1).argmin()[None]
    nearest = distances[medoids[0]]
    while len(medoids) < min(count, len(distances)):
        medoids = torch.cat([medoids, nearest.argmax()[None]])
        nearest = torch.minimum(nearest, distances[medoids[-1]])
    for _ in range(MEDOID_ROUNDS):
        group = F.one_hot(distances[:, medoids].argmin(dim=1), len(medoids)).to(distances)
        total = (distances @ group).masked_fill(group == 0, torch.inf)
        better = torch.where(group.any(dim=0), total.argmin(dim=0), medoids)
        if torch.equal(better, medoids):
            break
        medoids = better
    return medoids
