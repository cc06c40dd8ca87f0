"""Boxes, and square crops of fixed size with their camera matrices."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import as_boxes, check_positive, check_tensor


def whole_image_box(image: Tensor) -> Tensor:
    """(4,) box of a whole (..., H, W) image."""
    H, W = image.shape[-2:]
    return torch.tensor([-0.5, -0.5, W - 0.5, H - 0.5], dtype=torch.float32, device=image.device)


def check_boxes(boxes: Tensor, sizes: Sequence[tuple[int, int]]) -> None:
    """Refuse (B, 4) boxes that are empty, not finite or entirely outside their image, of the (H, W) in ``sizes``."""
    check_tensor(boxes, "boxes", (len(sizes), 4))
    for i, (box, (H, W)) in enumerate(zip(boxes.tolist(), sizes, strict=True)):
        x0, y0, x1, y1 = box
        number = f" {i}" if len(sizes) > 1 else ""
        name = f"box{number} ({x0:g}, {y0:g}, {x1:g}, {y1:g})"
        if not all(abs(v) < 1e9 for v in box):
            raise InvalidInputError(f"{name}: expected finite coordinates in px")
        if x1 <= x0 or y1 <= y0:
            raise InvalidInputError(f"{name}: expected X0 < X1 and Y0 < Y1; give corners, not width and height")
        if x1 <= -0.5 or y1 <= -0.5 or x0 >= W - 0.5 or y0 >= H - 0.5:
            raise InvalidInputError(f"{name}: entirely outside the {W} x {H} image; give its pixel coordinates")


def box_iou(boxes: Tensor, others: Tensor) -> Tensor:
    """(N, M) intersection over union of (N, 4) and (M, 4) boxes x0, y0, x1, y1; 0 where the union is empty.

    Example:
        >>> box_iou(torch.tensor([[0.0, 0.0, 2.0, 2.0]]), torch.tensor([[1.0, 0.0, 3.0, 2.0]]))
        tensor([[0.3333]])
    """
    common = torch.minimum(boxes[:, None, 2:], others[:, 2:]) - torch.maximum(boxes[:, None, :2], others[:, :2])
    overlap = common.clamp(min=0).prod(dim=-1)
    first, second = ((box[:, 2:] - box[:, :2]).clamp(min=0).prod(dim=-1) for box in (boxes, others))
    union = first[:, None] + second - overlap
    return overlap / torch.where(union > 0, union, torch.ones_like(union))


def square_boxes(boxes: Tensor, margin: float) -> Tensor:
    """(..., 4) squares around the boxes' centres, side = longer side x (1 + 2 margin).

    Example:
        >>> square_boxes(torch.tensor([0.0, 0.0, 10.0, 20.0]), 0.1).tolist()
        [-7.0, -2.0, 17.0, 22.0]
    """
    check_positive(margin, "margin", zero_ok=True)
    centre = 0.5 * (boxes[..., :2] + boxes[..., 2:])
    half = (0.5 + margin) * (boxes[..., 2:] - boxes[..., :2]).amax(dim=-1, keepdim=True)
    return torch.cat([centre - half, centre + half], dim=-1)


def crop_transforms(squares: Tensor, size: int) -> Tensor:
    """(..., 3, 3) maps from image to crop pixels, borders onto borders; ``A @ K`` is the crop's camera matrix."""
    scale = size / (squares[..., 2] - squares[..., 0])
    return _scale_and_shift(scale, -squares[..., 0] * scale - 0.5, -squares[..., 1] * scale - 0.5)


def image_transforms(squares: Tensor, size: int) -> Tensor:
    """The inverse of :func:`crop_transforms`, with exact zeros and ones, which LAPACK does not guarantee."""
    scale = (squares[..., 2] - squares[..., 0]) / size
    return _scale_and_shift(scale, squares[..., 0] + 0.5 * scale, squares[..., 1] + 0.5 * scale)


def _scale_and_shift(scale: Tensor, x: Tensor, y: Tensor) -> Tensor:
    zero, one = torch.zeros_like(scale), torch.ones_like(scale)
    rows = [torch.stack(row, -1) for row in ([scale, zero, x], [zero, scale, y], [zero, zero, one])]
    return torch.stack(rows, -2)


def crop_images(
    images: Tensor | Sequence[Tensor], boxes: Any, *, size: int = 256, margin: float = 0.1
) -> tuple[Tensor, Tensor]:
    """Square crops around boxes, resampled bilinearly, with a wider triangle filter (no aliasing) when shrinking.

    Crops are NaN where they depend on a pixel that is not finite. Half types are resampled in float32.

    Args:
        images: (B, C, H, W), or a list of (C, H, W) of different sizes. Pixels outside an image repeat its border.
        boxes: (B, 4) x0, y0, x1, y1 in px, a tensor, an array or lists; may extend beyond the image.
        margin: added on each side of the box, as a fraction of its longer side.

    Returns:
        crops (B, C, size, size) in the dtype of the images, and (B, 3, 3) :func:`crop_transforms`, at least float32.

    Raises:
        InvalidInputError: wrong shapes, or a box is empty or entirely outside its image.

    Example:
        >>> crops, A = crop_images(torch.rand(2, 3, 48, 64), torch.tensor([[4.0, 4, 40, 30], [10, 5, 60, 47]]), size=32)
        >>> crops.shape, A.shape
        (torch.Size([2, 3, 32, 32]), torch.Size([2, 3, 3]))
    """
    if isinstance(images, Tensor):
        check_tensor(images, "images", (None, None, None, None))
    else:
        for image in images:
            check_tensor(image, "images", (None, None, None))
    boxes = as_boxes(boxes, len(images))
    check_boxes(boxes, [(int(image.shape[-2]), int(image.shape[-1])) for image in images])
    squares = square_boxes(boxes, margin)
    A = crop_transforms(squares, size)
    if isinstance(images, Tensor):
        return _resample(images, squares, size), A
    crops = [_resample(image[None], squares[i : i + 1], size) for i, image in enumerate(images)]
    if not crops:
        raise InvalidInputError("images: expected at least one image in the list")
    return torch.cat(crops), A


def _resample(images: Tensor, squares: Tensor, size: int) -> Tensor:
    """(B, C, size, size) crops of (B, C, H, W) images, in their dtype."""
    H, W = images.shape[-2:]
    # Half types cannot represent pixel coordinates: bfloat16 has eight bits.
    x = images.to(torch.promote_types(images.dtype, torch.float32))
    squares = squares.to(x)
    rows = _triangle_weights(squares[:, 1], squares[:, 3], size, H)[:, None]
    columns = _triangle_weights(squares[:, 0], squares[:, 2], size, W)[:, None]
    crops = rows @ (x @ columns.mT)
    if not bool(crops.isfinite().all()):  # 0 times NaN is NaN: one missing pixel would spread along its row and column
        missing = ~x.isfinite()
        weight = rows @ (missing.to(x) @ columns.mT)
        crops = torch.where(weight > 0, torch.nan, rows @ (torch.where(missing, 0.0, x) @ columns.mT))
    return crops.to(images.dtype)


def _triangle_weights(low: Tensor, high: Tensor, size: int, length: int) -> Tensor:
    """(B, size, length) weights of input samples in each output sample; rows sum to 1."""
    scale = ((high - low) / size)[:, None]
    index = torch.arange(size, device=low.device, dtype=low.dtype) + 0.5
    centres = (low[:, None] + index * scale).clamp(0, length - 1)[..., None]
    samples = torch.arange(length, device=low.device, dtype=low.dtype)
    weights = (1.0 - (samples - centres).abs() / scale.clamp(min=1.0)[..., None]).clamp(min=0.0)
    return weights / weights.sum(dim=-1, keepdim=True)
