"""Features of photographs: crops of a box and of jittered copies of it, their fields, descriptors and points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field

import torch
from torch import Tensor, nn

from ..errors import InvalidInputError
from ..filters.operations import fill_missing, may_have_missing, missing_mask, to_grey
from ..geometry.crops import check_boxes, crop_squares, square_boxes
from ..utils.checks import as_numbers, check_photograph, check_tensor

BORDER_DISTANCE = 0.01  # of a box cut off by the image's border, as a fraction of its longer side, plus 1 px
# Shifts in x and y in units of the box jitter, and the exponent of the scale
_JITTER = ((0, 0, 0), (-0.75, 0, 0), (0.75, 0, 0), (0, -0.75, 0), (0, 0.75, 0), (0, 0, -1), (0, 0, 1))
_BATCHED = ("regions", "field", "descriptors", "points", "shapes")


@dataclass(frozen=True)
class QueryFeatures:
    """B photographs, each described in K crops: of its box first, then of jittered copies of the box.

    Attributes:
        regions: (B, K, C, S, S) the crops, in [0, 1]; NaN where pixels of the photograph are missing.
        field: (B, 2, S, S) of the first crop.
        descriptors: (B, K, D).
        points: (B, K, S, S) bool feature points.
        shapes: (B,) log of width / height of the boxes, NaN where unknown.
        reranking_features: features of the crops that reranking terms have computed, by the term's name.
    """

    regions: Tensor
    field: Tensor
    descriptors: Tensor
    points: Tensor
    shapes: Tensor
    reranking_features: dict[str, Tensor] = dataclass_field(default_factory=dict, compare=False)

    def __len__(self) -> int:
        return self.regions.shape[0]

    def __getitem__(self, index: slice | Tensor) -> "QueryFeatures":
        return replace(self, reranking_features={}, **{n: getattr(self, n)[index] for n in _BATCHED})

    @property
    def crops(self) -> Tensor:
        """(B, C, S, S) crops of the boxes themselves."""
        return self.regions[:, 0]


def photograph_field(field: nn.Module, crops: Tensor) -> Tensor:
    """(B, 2, S, S) field of (B, 1 or 3, S, S) crops, in grey unless the filter has an attribute ``colour = True``.
    Missing pixels (NaN or infinite) are filled from their surroundings before the filter; the field is 0 there."""
    if crops.shape[1] not in (1, 3):
        raise InvalidInputError(f"images: expected 1 (grey) or 3 (RGB) channels, got {crops.shape[1]}")
    grey = crops.shape[1] == 3 and not getattr(field, "colour", False)
    holes = missing_mask(crops) if may_have_missing(crops) else None
    crops = crops if holes is None else fill_missing(crops, holes)
    out: Tensor = field(to_grey(crops) if grey else crops)
    return out if holes is None else out.masked_fill(holes.any(dim=1, keepdim=True), 0.0)


def jittered_boxes(boxes: Tensor, box_jitter: float) -> Tensor:
    """(B, K, 4) of (B, 4) boxes: each box, four copies shifted by 3/4 ``box_jitter`` of its longer side, two scaled.
    ``box_jitter`` is a fraction in [0, 0.45]; K = 7, or 1 for ``box_jitter`` = 0."""
    boxes = as_numbers(boxes, "boxes")
    check_tensor(boxes, "boxes", (None, 4))
    if not 0.0 <= box_jitter <= 0.45:
        raise InvalidInputError(f"box_jitter: expected a fraction in [0, 0.45], got {box_jitter}")
    jitter = torch.tensor(_JITTER if box_jitter else _JITTER[:1], dtype=boxes.dtype, device=boxes.device)
    sides = boxes[:, 2:] - boxes[:, :2]
    shift = box_jitter * jitter[None, :, :2] * sides.amax(dim=1)[:, None, None]
    centre = 0.5 * (boxes[:, None, :2] + boxes[:, None, 2:]) + shift
    half = 0.5 * sides[:, None] * (1.0 + box_jitter) ** jitter[None, :, 2:]
    return torch.cat([centre - half, centre + half], dim=2)


def crop_regions(images: Tensor | Sequence[Tensor], boxes: Tensor, *, size: int, margin: float) -> Tensor:
    """(B, K, C, S, S) crops of K boxes per image, as :func:`crop_images` cuts them, on the device of the boxes.

    Args:
        images: (B, C, H, W), or a list of (C, H, W), floating in [0, 1] or uint8; if channel counts differ, grey images
            get three channels.
        boxes: (B, K, 4) in px, from :func:`jittered_boxes`. A box entirely outside its image is replaced by the first
            box, which must not be outside.
    """
    for image in images:
        check_photograph(image)
    sizes = [(int(image.shape[-2]), int(image.shape[-1])) for image in images]
    boxes = as_numbers(boxes, "boxes")
    check_tensor(boxes, "boxes", (len(sizes), None, 4))
    check_boxes(boxes[:, 0], sizes)
    if not sizes:
        return boxes.new_zeros(0, boxes.shape[1], 3, size, size)
    channels = max(image.shape[0] for image in images)
    crops = []
    for image, each, (H, W) in zip(images, boxes, sizes, strict=True):
        end = torch.tensor([W - 0.5, H - 0.5], dtype=each.dtype, device=each.device)
        visible = (each[:, 2:] > -0.5).all(dim=1) & (each[:, :2] < end).all(dim=1)
        each = torch.where(visible[:, None], each, each[:1])
        cut = crop_squares(image, square_boxes(each, margin), size).to(boxes.device)
        crops.append(cut.expand(-1, channels, -1, -1))
    return torch.stack(crops)


def box_shapes(boxes: Tensor) -> Tensor:
    """(...,) log of width / height of (..., 4) boxes x0, y0, x1, y1."""
    sides = boxes[..., 2:] - boxes[..., :2]
    return torch.log(sides[..., 0] / sides[..., 1])


def whole_box_shapes(boxes: Tensor, sizes: Sequence[tuple[int, int]]) -> Tensor:
    """(B,) shapes of (B, 4) boxes in px in images of ``sizes`` (H, W); NaN if the border may cut the object off."""
    end = torch.tensor([[W, H] for H, W in sizes], dtype=boxes.dtype, device=boxes.device).view(-1, 2) - 0.5
    border = 1.0 + BORDER_DISTANCE * (boxes[:, 2:] - boxes[:, :2]).amax(dim=1, keepdim=True)
    inside = (boxes[:, :2] > -0.5 + border).all(dim=1) & (boxes[:, 2:] < end - border).all(dim=1)
    return torch.where(inside, box_shapes(boxes), torch.nan)
