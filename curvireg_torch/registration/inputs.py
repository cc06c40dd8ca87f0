"""Photographs, boxes and cameras in the forms that callers have them, checked one by one.

Boxes and cameras that are possible, but probably a mistake, give warnings: a result from them is never reliable.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor

from ..data.images import read_photo
from ..errors import CurviregError, ImageError, InvalidInputError
from ..geometry.crops import check_boxes, whole_image_box
from ..geometry.pose_prior import PosePrior
from ..utils.checks import (
    are_nearly_equal,
    as_boxes,
    as_camera_matrices,
    check_camera_matrix,
    check_photograph,
    check_pixels,
    check_square_pixels,
)

__all__ = ["ImageItem", "camera_warnings", "check_box_side", "check_crop", "image_item", "image_items"]

MIN_BOX_SIDE = 12
"""Pixels; a smaller box is refused. With one of 1 px, the preset "fast" reached a confidence of 0.98."""

SMALL_BOX_SIDE = 24
"""Pixels; of a smaller box a result carries a warning."""

FOCAL_RANGE = (1 / 3, 20.0)
"""Focal lengths of usual cameras, as multiples of the photograph's longer side: fields of view of 113 to 3 degrees."""


@dataclass(frozen=True)
class ImageItem:
    """One photograph to register: ``image`` (1 or 3, H, W) float or uint8, ``box`` (4,), ``camera_matrix`` (3, 3).

    Raises:
        InvalidInputError: something else, an empty box or one outside the image, skew, or pixels that are not square.
    """

    image: Tensor
    box: Tensor
    camera_matrix: Tensor | None
    prior: PosePrior | None = None

    def __post_init__(self) -> None:
        check_photograph(self.image, "photograph")
        check_boxes(self.box[None], [self.size])
        if self.camera_matrix is not None:
            check_camera_matrix(self.camera_matrix)
            check_square_pixels(self.camera_matrix)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the photograph."""
        return int(self.image.shape[-2]), int(self.image.shape[-1])

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is questionable about box and camera, see :func:`input_warnings`."""
        return input_warnings(self.box, self.camera_matrix, self.size)


def image_items(
    images: Tensor | Sequence[Any],
    boxes: Any,
    camera_matrices: Any | None,
    prior: PosePrior | Sequence[PosePrior | None] | None = None,
) -> Sequence[ImageItem | CurviregError]:
    """Photographs with boxes (None: the whole images) and cameras, or their errors; arguments as of ``Registrar``.

    Each is read and checked whenever it is asked for, so that many large files need the memory of few. A box of which
    too little lies inside its photograph is refused, see :func:`check_box_side`.

    Raises:
        InvalidInputError: not as many boxes, cameras or priors as images, or a distance limited without cameras.
    """
    if isinstance(images, str | PathLike) or (isinstance(images, Tensor) and images.ndim != 4):
        raise InvalidInputError("images: expected a batch (B, C, H, W) or a list; put a single image into a list")
    n = len(images)
    boxes = None if boxes is None else as_boxes(boxes, n)
    cameras: Sequence[Tensor | None] = [None] * n
    if camera_matrices is not None:
        cameras = list(as_camera_matrices(camera_matrices, n).detach().cpu())
    priors = [prior] * n if prior is None or isinstance(prior, PosePrior) else list(prior)
    if len(priors) != n or not all(p is None or isinstance(p, PosePrior) for p in priors):
        raise InvalidInputError(f"prior: expected a PosePrior, or a list of {n} with None where there is none")
    if camera_matrices is None and any(p is not None and p.distance is not None for p in priors):
        raise InvalidInputError("distance: needs the camera matrix of every photograph")

    def item(i: int) -> ImageItem | CurviregError:
        try:
            item = image_item(images[i], None if boxes is None else boxes[i], cameras[i], priors[i])
            check_box_side(item.box, item.size)
            return item
        except CurviregError as error:
            return error.with_subject(": ".join([f"image {i}", *([error.subject] if error.subject else [])]))

    return OnDemand(item, n)


def image_item(
    image: Any, box: Tensor | None, camera_matrix: Tensor | None = None, prior: PosePrior | None = None
) -> ImageItem:
    """One photograph in any form, with its (4,) box (None: the whole image), however small that is."""
    pixels = _pixels(image)
    box = whole_image_box(pixels) if box is None else box.detach().float()
    return ImageItem(pixels, box.cpu(), camera_matrix, prior)


class OnDemand(Sequence[ImageItem | CurviregError]):
    """``item(0)`` to ``item(count - 1)``, computed at each access."""

    def __init__(self, item: Callable[[int], ImageItem | CurviregError], count: int) -> None:
        self._item, self._indices = item, range(count)

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> ImageItem | CurviregError: ...
    @overload
    def __getitem__(self, index: slice) -> list[ImageItem | CurviregError]: ...
    def __getitem__(self, index: int | slice) -> Any:
        found = self._indices[index]
        return self._item(found) if isinstance(found, int) else [self._item(i) for i in found]


def _pixels(image: Any) -> Tensor:
    if isinstance(image, str | PathLike):
        return read_photo(image).image
    if isinstance(image, np.ndarray):
        if not (np.issubdtype(image.dtype, np.number) or image.dtype == bool):
            raise InvalidInputError(f"photograph: expected an array of numbers, got {image.dtype}")
        image = torch.from_numpy(np.ascontiguousarray(image))
        image = image[None] if image.ndim == 2 else image.movedim(-1, 0) if image.ndim == 3 else image
    if not isinstance(image, Tensor):
        raise InvalidInputError(f"expected a tensor, an array or a path, got {type(image).__name__}")
    check_photograph(image, "photograph")
    return image


def check_crop(crop: Tensor) -> None:
    """Raise :class:`ImageError` for a (C, S, S) crop that shows nothing to register."""
    check_pixels(crop, "of the box")
    if float(crop.amax() - crop.amin()) < 1.0 / 255.0:
        raise ImageError("the box shows one colour, nothing to register; check image and box")


def input_warnings(box: Tensor, camera_matrix: Tensor | None, size: tuple[int, int]) -> tuple[str, ...]:
    """What is questionable about the (4,) box and the (3, 3) camera of an (H, W) photograph; each names the mistake."""
    warnings = [] if camera_matrix is None else camera_warnings(camera_matrix, size)
    if (side := _visible_side(box, size)) < SMALL_BOX_SIDE:
        warnings.append(
            f"the box shows {side:.0f} px on its shorter side; use a picture with at least {SMALL_BOX_SIDE}"
        )
    return tuple(warnings)


def check_box_side(box: Tensor, size: tuple[int, int]) -> None:
    """Refuse a box of which less than ``MIN_BOX_SIDE`` px lie inside the (H, W) photograph in a direction."""
    side = _visible_side(box, size)
    if side < MIN_BOX_SIDE:
        where = "the photograph has" if min(size) < MIN_BOX_SIDE else "the part of the photograph in the box has"
        raise InvalidInputError(
            f"{where} {side:.1f} px on its shorter side, at least {MIN_BOX_SIDE} are needed; use a larger picture"
        )


def camera_warnings(K: Tensor, size: tuple[int, int]) -> list[str]:
    """What is questionable about a valid (3, 3) camera matrix of an (H, W) photograph.

    Example:
        >>> swapped = torch.tensor([[325.0, 0, 572], [0, 325, 573], [0, 0, 1]])
        >>> camera_warnings(swapped, (480, 640))[0].rpartition("; ")[-1]
        'FX FY and CX CY seem to be swapped'
        >>> camera_warnings(torch.tensor([[572.0, 0, 325], [0, 573, 242], [0, 0, 1]]), (480, 640))
        []
    """
    fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    H, W = size
    found = []
    if not _is_inside(cx, cy, size):
        found.append(
            f"the principal point ({cx:g}, {cy:g}) lies outside the photograph of {W} x {H} px; "
            f"{_likely_mistake(fx, fy, cx, cy, size)}"
        )
    low, high = FOCAL_RANGE
    focal, side = min(fx, fy), max(W, H)
    if not low * side <= focal <= high * side:
        degrees = 2 * math.degrees(math.atan(W / 2 / fx))
        advice = "it is in px of this photograph, not in mm" if focal < side else "scale it with the photograph"
        found.append(
            f"the focal length of {focal:g} px gives the photograph of {W} x {H} px a field of view of {degrees:.2g} "
            f"degrees; {advice}"
        )
    return found


def _likely_mistake(fx: float, fy: float, cx: float, cy: float, size: tuple[int, int]) -> str:
    """Of a camera whose principal point lies outside the (H, W) photograph."""
    H, W = size
    if _is_inside(fx, fy, size) and are_nearly_equal(cx, cy):
        return "FX FY and CX CY seem to be swapped"
    if cx >= W - 1 and cy >= H - 1:
        return f"this camera seems to belong to a picture of about {2 * cx + 1:.0f} x {2 * cy + 1:.0f} px; scale it"
    return "it is near the centre, unless the picture was cropped"


def _is_inside(x: float, y: float, size: tuple[int, int]) -> bool:
    """Whether a point lies in an (H, W) picture and not in its corner (0, 0), which stands for unknown values."""
    H, W = size
    return -0.5 < x < W - 0.5 and -0.5 < y < H - 0.5 and (x, y) != (0.0, 0.0)


def _visible_side(box: Tensor, size: tuple[int, int]) -> float:
    """Pixels of the shorter side of the part of a (4,) box that lies inside an (H, W) picture."""
    H, W = size
    limits = torch.tensor([W, H], dtype=torch.float64) - 0.5
    inside = torch.minimum(box[2:].double().cpu(), limits) - box[:2].double().cpu().clamp(min=-0.5)
    return float(inside.min())
