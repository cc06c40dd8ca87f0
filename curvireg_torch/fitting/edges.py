"""Edges of photographs around objects, and how far an object's mask agrees with them."""

from collections.abc import Sequence
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from ..filters.operations import central_gradient, fill_missing, smooth
from ..geometry.crops import crop_transforms, square_boxes
from ..geometry.framing import inside_boxes, photograph_box
from ..rendering.contours import ContourPoints
from ..terms import crop_photographs
from ..utils.checks import check_pixels

CROP_SIZE = 256
"""Side of the crops in px; the first rounds use half of it."""

MASK_DISTANCE = 6.0 / 256.0
"""Distance from an edge at which the mask is read on both sides, as a fraction of the crop's side:
about 1.5 px of the learned mask."""

MASK_TRUST = 0.7
"""Weight that an edge loses where the mask contradicts it."""

OUTLINE_WEIGHT = 2.0
"""Weight of the outline relative to creases and inner contours, which prints and reflections
imitate."""


class EdgeField:
    """Edges of image crops (B, C, S, S) in [0, 1]; the strongest of several channels counts.

    ``inside`` (B, 1, S, S), if given, is 0 where edges do not count, such as outside the
    photograph, though crops repeat its border.
    """

    def __init__(self, crops: Tensor, inside: Tensor | None = None) -> None:
        gx, gy = central_gradient(smooth(crops, 1.0))
        self._inside = torch.ones_like(crops[:, :1]) if inside is None else inside.to(crops)
        gradient = torch.stack([gx, gy], dim=2).flatten(1, 2) * self._inside
        self._gradient = _Pictures(gradient, "constant")
        # by channels: threads share out a single sum, which rounds it otherwise
        energy = gradient.square().sum(dim=(2, 3)).sum(dim=1)
        area = self._inside.sum(dim=(1, 2, 3))
        self._level = (energy / area.clamp(min=1)).sqrt().clamp(min=1e-6)

    def strength(
        self, uv: Tensor, normals: Tensor, offsets: tuple[float, ...], poses: "PosesByPicture"
    ) -> Tensor:
        """Strength of the image gradient across a contour, at offsets along its normals.

        With g the gradient, m the crop's root mean square gradient and c = ``|n . g| / |g|``, r =
        ``|n . g| c^4`` gives the strength r / (r + m). It is 0 outside the crop; c^4 is one half
        where n and g differ by 33 degrees.

        Args:
            uv, normals: (N, P, 2) float64 pixels of the crops and unit vectors.
            offsets: L of them, px along the normals.
            poses: N of them, by crop.

        Returns:
            (N, P, L) float32 in [0, 1).
        """
        normals = poses.as_table(normals)
        gradient = self._gradient.along(
            poses, poses.as_table(uv), normals, offsets, self._gradient.side
        )
        gx = gradient[0::2]
        gy = gradient[1::2]
        nx, ny = normals.to(gx.dtype)[..., None, :].unbind(-1)
        across = (gx * nx).addcmul_(gy, ny).square_()
        cosine = across / (gx * gx).addcmul_(gy, gy).clamp_(min=1e-20)
        r = cosine.square_().mul_(across.sqrt_()).amax(dim=0)
        return poses.as_rows(r / (r + self._level[poses.shown, None, None, None]))

    def counts(self, uv: Tensor, valid: Tensor, image_index: Tensor) -> Tensor:
        """(N, P) bool: ``valid`` points that count when the support of a pose is averaged, all but
        those outside the photograph; but then half of the points at least."""
        S = self._inside.shape[-1]
        x, y = uv.round().long().clamp(0, S - 1).unbind(-1)
        here = valid & (self._inside[image_index[:, None], 0, y, x] > 0)
        enough = 2 * here.sum(dim=1, keepdim=True) >= valid.sum(dim=1, keepdim=True)
        return torch.where(enough, here, valid)


class ObjectMask:
    """Probabilities (B, 1, s, s) that pixels of image crops belong to the object."""

    def __init__(self, probability: Tensor) -> None:
        self.probability = probability.detach().float()
        self._pictures = _Pictures(self.probability, "replicate")

    def weights(
        self,
        uv: Tensor,
        points: ContourPoints,
        offsets: tuple[float, ...],
        poses: "PosesByPicture",
        size: int,
    ) -> Tensor:
        """How well edges at offsets along the normals of contour points agree with the mask.

        With p and q the probabilities 6/256 of the crop's side inward and outward of an edge, an
        edge of the outline has weight 2 (0.3 + 0.7 max(p - q, 0)), one within the object 0.3 + 0.7
        min(p, q).

        Args:
            uv: (N, P, 2) float64 px of the points in crops of ``size`` px.
            offsets: L of them, px along the normals.
            image_index: (N,) the crop of each pose.

        Returns:
            (N, P, L) float32, at most 2.
        """
        aside = MASK_DISTANCE * size
        at = tuple(offset + side for side in (-aside, aside) for offset in offsets)
        probability = self._pictures.along(
            poses, poses.as_table(uv), poses.as_table(points.normals), at, size
        )
        inside, outside = poses.as_rows(probability[0]).chunk(2, dim=-1)
        outline = (inside - outside).clamp(min=0.0)
        within = torch.minimum(inside, outside)
        is_outline = points.outline[..., None]
        agreement = 1.0 - MASK_TRUST + MASK_TRUST * torch.where(is_outline, outline, within)
        return agreement * self.largest_weights(points)[..., None]

    @staticmethod
    def largest_weights(points: ContourPoints) -> Tensor:
        """(N, P) float32 weights of edges that agree with the mask: 2 for the outline, else 1."""
        return 1.0 + (OUTLINE_WEIGHT - 1.0) * points.outline.float()


class _Pictures:
    """Pictures (B, C, S, S), sampled along lines, with a border of a pixel around each: zeros for
    ``padding`` "constant", or what is beside them for "replicate"."""

    def __init__(self, pictures: Tensor, padding: str) -> None:
        self.side = pictures.shape[-1]
        bordered = F.pad(pictures, (1, 1, 1, 1), mode=padding)
        # a quarter of the time of an edge field goes where channels are far apart
        self.bordered = bordered.contiguous(memory_format=torch.channels_last)

    def along(
        self,
        poses: "PosesByPicture",
        uv: Tensor,
        normals: Tensor,
        offsets: tuple[float, ...],
        size: int,
    ) -> Tensor:
        """(C, B, M, P, L) float32 values at L offsets in px from points (B, M, P, 2) along normals,
        of M poses in each picture; points and offsets refer to a side of ``size`` px."""
        B, M, P, _ = uv.shape
        C, width = self.bordered.shape[1:3]
        scale, shift, steps = _sampling(offsets, width, self.side / size, uv.device)
        lines = torch.cat([torch.addcmul(shift, uv, scale), scale * normals], dim=-1)
        # A matrix product is four times as fast as start + offset x normal with its short rows.
        grid = torch.bmm(lines.float().flatten(0, 1), steps.expand(B * M, -1, -1))
        sampled: Tensor = F.grid_sample(
            self.bordered[poses.shown],
            grid.view(B, M * P, len(offsets), 2),
            padding_mode="border",
            align_corners=False,
        )
        return sampled.view(B, C, M, P, len(offsets)).transpose(0, 1)


class PosesByPicture:
    """N poses, of the pictures ``image_index`` (N,), as a table (B, M): M of each of the pictures
    ``shown``, B in a row, with empty places where there are fewer. So one call samples all
    pictures, each with pixels of its own."""

    def __init__(self, image_index: Tensor) -> None:
        first = 0
        end = 1
        if len(image_index):
            first = int(image_index.min())
            end = int(image_index.max()) + 1
        self.shown = slice(first, end)
        self.pictures = end - first
        if self.pictures > 1:
            row = image_index - first
            is_in = row == torch.arange(self.pictures, device=row.device)[:, None]
            number = is_in.cumsum(dim=1)
            self.most = int(number[:, -1].max())
            self.place = self.most * row + number.gather(0, row[None])[0] - 1

    def as_table(self, x: Tensor) -> Tensor:
        """(B, M, ...) of the poses' (N, ...)."""
        if self.pictures == 1:
            return x[None]
        table = x.new_zeros(self.pictures * self.most, *x.shape[1:])
        table.index_copy_(0, self.place, x)
        return table.view(self.pictures, self.most, *x.shape[1:])

    def as_rows(self, table: Tensor) -> Tensor:
        """(N, ...) of the poses' (B, M, ...)."""
        return table.flatten(0, 1).index_select(0, self.place) if self.pictures > 1 else table[0]


@lru_cache(maxsize=256)
def _sampling(
    offsets: tuple[float, ...], width: int, ratio: float, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """From px, each of which is ``ratio`` px of a picture, to the units of grid_sample, in which
    the sides of a picture are 2: the scale and the shift of points; and the (4, 2 L) matrix that
    takes the scaled x and y of a point and its normal to places at L offsets."""
    unit = torch.tensor(2.0 / width, dtype=torch.float64, device=device)
    scale = ratio * unit
    along = torch.tensor(offsets, dtype=torch.float32, device=device)
    steps = torch.stack([torch.ones_like(along), along])
    axes = torch.eye(2, dtype=torch.float32, device=device)
    steps = (steps[:, None, :, None] * axes[:, None]).view(4, -1)
    return scale, 0.5 * scale + unit - 1.0, steps


class EdgeCrops:
    """Crops of the boxes of B photographs, as contours are fitted to them: at full size, half of it
    and a quarter, each computed on first use.

    Args:
        crops: (B, C, S, S) in [0, 1], without missing pixels.
        inside: (B, 1, S, S), 1 where edges count, see :func:`inside_boxes`.
        transforms: (B, 3, 3) from pixels of the photographs to those of the crops.
        mask: (B, 1, s, s) probability that pixels of the crops belong to the object.
    """

    def __init__(
        self, crops: Tensor, inside: Tensor, transforms: Tensor, mask: Tensor | None = None
    ) -> None:
        self.crops = crops
        self.transforms = transforms.double()
        self._inside = inside
        self.mask = None if mask is None else ObjectMask(mask)
        self._fields: dict[int, EdgeField] = {}
        self._copies: dict[torch.device, EdgeCrops] = {}

    @classmethod
    def cut(
        cls,
        images: Sequence[Tensor],
        boxes: Tensor,
        margin: float,
        mask: Tensor | None = None,
        *,
        shown: Tensor | None = None,
    ) -> "EdgeCrops":
        """Cut the boxes (B, 4) with their ``margin`` out of photographs; grey ones get three equal
        channels, as :func:`.read_photo` gives them: the level of edges is a sum over channels.
        Edges count within the boxes ``shown`` (B, 4), by default in the whole photographs."""
        cut = crop_photographs(images, boxes, size=CROP_SIZE, margin=margin).float()
        crops = fill_missing(cut.expand(-1, 3, -1, -1))
        check_pixels(crops, "of the box")
        transforms = crop_transforms(square_boxes(boxes, margin), CROP_SIZE)
        mask = None if mask is None else mask.cpu()
        if shown is None:
            sizes = [(int(image.shape[-2]), int(image.shape[-1])) for image in images]
            shown = torch.stack([photograph_box(size) for size in sizes])
        return cls(crops, inside_boxes(shown, boxes, CROP_SIZE, margin), transforms, mask)

    @classmethod
    def cat(cls, parts: Sequence["EdgeCrops"]) -> "EdgeCrops":
        """The crops of several photographs together."""
        crops, inside, transforms = (
            torch.cat([getattr(part, name) for part in parts])
            for name in ("crops", "_inside", "transforms")
        )
        masks = [part.mask.probability for part in parts if part.mask is not None]
        return cls(crops, inside, transforms, torch.cat(masks) if masks else None)

    def to(self, device: torch.device) -> "EdgeCrops":
        """The crops on a device, copied there once."""
        if device == self.crops.device:
            return self
        if device not in self._copies:
            crops, inside, transforms = (
                x.to(device) for x in (self.crops, self._inside, self.transforms)
            )
            mask = None if self.mask is None else self.mask.probability.to(device)
            self._copies[device] = EdgeCrops(crops, inside, transforms, mask)
        return self._copies[device]

    def edges(self, factor: int) -> EdgeField:
        """The edges in crops whose sides are smaller by a factor."""
        if factor not in self._fields:
            crops = self.crops
            inside = self._inside
            if factor > 1:
                crops = F.avg_pool2d(crops, factor)
                inside = F.avg_pool2d(inside, factor).floor()
            self._fields[factor] = EdgeField(crops, inside)
        return self._fields[factor]
