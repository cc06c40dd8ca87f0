"""Boxes, and square crops of fixed size with their camera matrices."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..errors import MAX_BOX_COORDINATE, InvalidInputError
from ..utils.aliases import Size
from ..utils.checks import as_boxes, check_integer, check_positive, check_tensor
from ..utils.likes import BoxesLike
from ..utils.precision import full_precision
from .conversions import matrix_of_rows

SAMPLES_AT_A_TIME = 64  # of a matrix product: fewer are slow, more multiply by many zeros


def whole_image_box(image: Tensor) -> Tensor:
    """(4,) box of a whole (..., H, W) image.

    Example:
        >>> whole_image_box(torch.zeros(3, 480, 640)).tolist()
        [-0.5, -0.5, 639.5, 479.5]
    """
    H, W = image.shape[-2:]
    return torch.tensor([-0.5, -0.5, W - 0.5, H - 0.5], dtype=torch.float32, device=image.device)


def check_boxes(boxes: Tensor, sizes: Sequence[Size]) -> None:
    """Refuse (B, 4) boxes that are empty, not finite or entirely outside their image, of the (H, W)
    in ``sizes``."""
    check_tensor(boxes, "boxes", (len(sizes), 4))
    for i, (box, (H, W)) in enumerate(zip(boxes.tolist(), sizes, strict=True)):
        x0, y0, x1, y1 = box
        number = f" {i}" if len(sizes) > 1 else ""
        name = f"box{number} ({x0:g}, {y0:g}, {x1:g}, {y1:g})"
        if not all(map(math.isfinite, box)):
            raise InvalidInputError(f"{name}: expected finite coordinates in px")
        if max(map(abs, box)) > MAX_BOX_COORDINATE:
            raise InvalidInputError(
                f"{name}: coordinates beyond {MAX_BOX_COORDINATE:g} px; give pixel coordinates of "
                f"the {W} x {H} image"
            )
        if x1 <= x0 or y1 <= y0:
            raise InvalidInputError(
                f"{name}: expected X0 < X1 and Y0 < Y1; give corners, not width and height",
                kind="corners",
            )
        if x1 <= -0.5 or y1 <= -0.5 or x0 >= W - 0.5 or y0 >= H - 0.5:
            raise InvalidInputError(
                f"{name}: entirely outside the {W} x {H} image; give its pixel coordinates"
            )


def box_iou(boxes: Tensor, others: Tensor) -> Tensor:
    """(N, M) intersection over union of (N, 4) and (M, 4) boxes x0, y0, x1, y1; 0 where the union
    is empty.

    Example:
        >>> boxes = torch.tensor([[0.0, 0.0, 4.0, 4.0], [4.0, 0.0, 8.0, 4.0]])
        >>> box_iou(boxes, boxes[:1]).tolist()
        [[1.0], [0.0]]
    """
    common = torch.minimum(boxes[:, None, 2:], others[:, 2:]) - torch.maximum(
        boxes[:, None, :2], others[:, :2]
    )
    overlap = common.clamp(min=0).prod(dim=-1)
    first, second = ((box[:, 2:] - box[:, :2]).clamp(min=0).prod(dim=-1) for box in (boxes, others))
    union = first[:, None] + second - overlap
    return overlap / torch.where(union > 0, union, torch.ones_like(union))


def box_share(box: Tensor, other: Tensor) -> float:
    """Share, in [0, 1], of the smaller of two boxes (4,), which are not empty, that lies in the
    other one: 1 where one contains the other.

    Example:
        >>> whole, part = torch.tensor([[0.0, 0.0, 4.0, 4.0], [3.0, 0.0, 5.0, 2.0]])
        >>> box_share(whole, part)
        0.5
    """
    common = torch.minimum(box[2:], other[2:]) - torch.maximum(box[:2], other[:2])
    smaller = min((each[2:] - each[:2]).prod() for each in (box, other))
    return float(common.clamp(min=0).prod() / smaller)


def non_maximum_suppression(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Indices of (N, 4) boxes by falling score (N,), without those that overlap a better one by
    more than an IoU."""
    from kornia.geometry.bbox import nms  # here, because its import takes 0.3 s

    kept: Tensor = nms(boxes, scores, threshold)
    return kept


def square_boxes(boxes: Tensor, margin: float) -> Tensor:
    """(..., 4) squares around the boxes' centres, side = longer side x (1 + 2 margin).

    Example:
        >>> square_boxes(torch.tensor([[0.0, 0.0, 10.0, 20.0]]), 0.0).tolist()
        [[-5.0, 0.0, 15.0, 20.0]]
    """
    check_positive(margin, "margin", zero_ok=True)
    centre = 0.5 * (boxes[..., :2] + boxes[..., 2:])
    half = (0.5 + margin) * (boxes[..., 2:] - boxes[..., :2]).amax(dim=-1, keepdim=True)
    return torch.cat([centre - half, centre + half], dim=-1)


def crop_transforms(squares: Tensor, size: int) -> Tensor:
    """(..., 3, 3) maps from image to crop pixels, borders onto borders; ``A @ K`` is the crop's
    camera matrix.

    Example:
        >>> A = crop_transforms(torch.tensor([[10.0, 20.0, 42.0, 52.0]]), 64)
        >>> (A[0] @ torch.tensor([10.0, 20.0, 1.0], dtype=A.dtype)).tolist()
        [-0.5, -0.5, 1.0]
    """
    scale = size / (squares[..., 2] - squares[..., 0])
    return _scale_and_shift(scale, -squares[..., 0] * scale - 0.5, -squares[..., 1] * scale - 0.5)


def image_transforms(squares: Tensor, size: int) -> Tensor:
    """The inverse of :func:`crop_transforms`, with exact zeros and ones, which LAPACK does not
    guarantee."""
    scale = (squares[..., 2] - squares[..., 0]) / size
    return _scale_and_shift(scale, squares[..., 0] + 0.5 * scale, squares[..., 1] + 0.5 * scale)


def _scale_and_shift(scale: Tensor, x: Tensor, y: Tensor) -> Tensor:
    zero = torch.zeros_like(scale)
    one = torch.ones_like(scale)
    return matrix_of_rows([[scale, zero, x], [zero, scale, y], [zero, zero, one]])


@full_precision()
def crop_images(
    images: Tensor | Sequence[Tensor], boxes: BoxesLike, *, size: int = 256, margin: float = 0.1
) -> tuple[Tensor, Tensor]:
    """Square crops around boxes, resampled bilinearly, with a wider triangle filter (no aliasing)
    when shrinking.

    Crops are NaN where they depend on a pixel that is not finite. Half types are resampled in
    float32.

    Args:
        images: (B, C, H, W), or a list of (C, H, W) of different sizes. Pixels outside an image
            repeat its border.
        boxes: (B, 4) x0, y0, x1, y1 in px, a tensor, an array or lists; may extend beyond the
            image.
        margin: added on each side of the box, as a fraction of its longer side.

    Returns:
        crops (B, C, size, size) in the dtype of the images, and (B, 3, 3) :func:`crop_transforms`,
        at least float32.

    Raises:
        InvalidInputError: wrong shapes, or a box is empty or entirely outside its image.

    Example:
        >>> crops, A = crop_images(torch.rand(1, 3, 48, 64), [[4, 4, 40, 30]], size=32)
        >>> crops.shape, A.shape
        (torch.Size([1, 3, 32, 32]), torch.Size([1, 3, 3]))
    """
    if isinstance(images, Tensor):
        check_tensor(images, "images", (None, None, None, None))
    for image in images:
        check_tensor(image, "images", (None, None, None))
        check_tensor(image, "images", (len(images[0]), None, None))
    size = check_integer(size, "size")
    boxes = as_boxes(boxes, len(images))
    check_boxes(boxes, [(int(image.shape[-2]), int(image.shape[-1])) for image in images])
    squares = square_boxes(boxes, margin)
    A = crop_transforms(squares, size)
    crops = [
        crop_squares(image, square[None], size)
        for image, square in zip(images, squares, strict=True)
    ]
    if crops:
        return torch.cat(crops).to(images[0].dtype), A
    if isinstance(images, Tensor):
        return images.new_zeros(0, images.shape[1], size, size), A
    raise InvalidInputError("images: expected at least one image in the list")


def crop_squares(image: Tensor, squares: Tensor, size: int) -> Tensor:
    """(K, C, size, size) crops of K squares (K, 4) in px of one image (C, H, W), floating or uint8;
    at least float32. Resampled as in :func:`crop_images`; of a large image only the pixels that the
    crops depend on are read."""
    # Half types cannot represent pixel coordinates: bfloat16 has eight bits.
    dtype = torch.promote_types(image.dtype, torch.float32)
    borders = squares.to("cpu", dtype)  # many small steps
    rows, columns = (
        _Resampling(borders[:, i], borders[:, i + 2], size, image.shape[-1 - i]) for i in (1, 0)
    )
    x = image[:, rows.first : rows.end, columns.first : columns.end]

    def resampled(x: Tensor) -> Tensor:
        if x.device.type != "cpu":
            pixels = x.to(dtype) / 255.0 if x.dtype == torch.uint8 else x.to(dtype)
            down, across = (axis.matrices(x.device) for axis in (rows, columns))
            return down[:, None] @ pixels @ across[:, None].mT
        return torch.stack(
            [columns(strip.mT, k).mT for k, strip in enumerate(rows(x).split(size, dim=1))]
        )

    crops = resampled(x)
    # 0 times NaN is NaN: one missing pixel would spread along its row and column
    if not math.isfinite(float(crops.detach().sum())):
        missing = ~x.isfinite()
        crops = torch.where(
            resampled(missing.to(dtype)) > 0, torch.nan, resampled(torch.where(missing, 0.0, x))
        )
    return crops


def _triangle(samples: Tensor, centres: Tensor, widths: Tensor) -> Tensor:
    """Weights of samples (N,), of sum 1, for filters with centres and widths (..., 1)."""
    weights = (1.0 - (samples - centres).abs() / widths).clamp(min=0.0)
    return weights / weights.sum(dim=-1, keepdim=True)


class _Resampling:
    """Triangle filters, at least one pixel wide, that resample an axis of ``length`` between K
    pairs of borders (K,), from the input from ``first`` to ``end``. Neighbouring samples, of
    whichever crop, are computed together, by the product of a narrow matrix with the few inputs
    that they depend on."""

    def __init__(self, low: Tensor, high: Tensor, size: int, length: int) -> None:
        scale = ((high - low) / size)[:, None]
        index = torch.arange(size, device=low.device, dtype=low.dtype) + 0.5
        self._centres = (low[:, None] + index * scale).clamp(0, length - 1)
        self._widths = scale.clamp(min=1.0).expand(-1, size)
        self.first = max(0, int((self._centres - self._widths).amin()))
        self.end = min(length, int((self._centres + self._widths).amax()) + 1)

    def matrices(self, device: torch.device) -> Tensor:
        """(K, size, end - first) weights of all inputs for each sample: on a GPU the product with
        them, nearly all zeros, takes less time than many small ones."""
        samples = torch.arange(self.first, self.end, dtype=self._centres.dtype, device=device)
        centres = self._centres.to(device)[..., None]
        widths = self._widths.to(device)[..., None]
        return _triangle(samples, centres, widths)

    def __call__(self, x: Tensor, crop: int | None = None) -> Tensor:
        """(C, samples, W) of one crop, or of all in sequence, from the (C, end - first, W) input,
        converted where it is used."""
        which = slice(None) if crop is None else slice(crop, crop + 1)
        centres = self._centres[which].flatten()
        widths = self._widths[which].flatten()
        order = None  # the samples of one crop are in order
        if len(centres) > self._centres.shape[1]:
            order = centres.argsort(stable=True)
            centres = centres[order]
            widths = widths[order]
        parts = []
        for centre, width in zip(
            centres.split(SAMPLES_AT_A_TIME), widths.split(SAMPLES_AT_A_TIME), strict=True
        ):
            low = max(0, int((centre - width).amin()) - self.first)
            high = int((centre + width).amax()) + 1 - self.first
            part = x[:, low:high].to(centres.dtype)
            part = part.div_(255.0) if x.dtype == torch.uint8 else part
            begin = self.first + low
            end = begin + part.shape[1]
            samples = torch.arange(begin, end, device=centre.device, dtype=centre.dtype)
            parts.append(_triangle(samples, centre[:, None], width[:, None]).to(part) @ part)
        resampled = torch.cat(parts, dim=1)
        return resampled if order is None else resampled.index_select(1, order.argsort())
