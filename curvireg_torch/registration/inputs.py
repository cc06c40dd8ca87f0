"""Photographs, boxes and cameras as people have them, one by one made fit for the pipeline, or refused by name."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..data.images import read_photo
from ..errors import CurviregError, ImageError, InvalidInputError
from ..geometry.cameras import check_camera_matrix
from ..geometry.crops import check_boxes, whole_image_box

__all__ = ["Item", "check_crop", "items_of", "named"]


@dataclass(frozen=True)
class Item:
    """One photograph to register: ``image`` (1 or 3, H, W) float or uint8, ``box`` (4,), ``camera_matrix`` (3, 3)."""

    image: Tensor
    box: Tensor
    camera_matrix: Tensor | None


def items_of(images: Tensor | Sequence[Any], boxes: Any, camera_matrices: Any | None) -> list[Item | CurviregError]:
    """Every photograph with its box and camera, or what is wrong with it.

    Args:
        images: (B, C, H, W), or a list of tensors (C, H, W), arrays (H, W) or (H, W, C), or paths.
        boxes: (B, 4) x0, y0, x1, y1 in px; None: the whole images.
        camera_matrices: (B, 3, 3), or (3, 3) for all, in px; None: unknown.

    Raises:
        InvalidInputError: not as many boxes or cameras as images.
    """
    if isinstance(images, str | PathLike) or (isinstance(images, Tensor) and images.ndim != 4):
        raise InvalidInputError("images: expected a batch (B, C, H, W) or a list; put a single one into a list")
    n = len(images)
    whole = boxes is None
    boxes = torch.zeros(n, 4) if whole else torch.as_tensor(boxes)
    boxes = boxes.view(0, 4) if n == 0 and boxes.numel() == 0 else boxes
    if tuple(boxes.shape) != (n, 4):
        raise InvalidInputError(f"boxes: expected shape ({n}, 4), one for each image, got {tuple(boxes.shape)}")
    cameras: Sequence[Tensor | None] = [None] * n
    if camera_matrices is not None:
        K = torch.as_tensor(camera_matrices)
        if K.ndim == 3 and len(K) not in (1, n):
            raise InvalidInputError(f"camera_matrices: expected one or {n} matrices, got {len(K)}")
        if tuple(K.shape[-2:]) != (3, 3) or K.ndim not in (2, 3):
            raise InvalidInputError(f"camera_matrices: expected (3, 3) or ({n}, 3, 3), got {tuple(K.shape)}")
        cameras = list(K.detach().cpu().double().expand(n, 3, 3))
    out: list[Item | CurviregError] = []
    for i in range(n):
        try:
            out.append(_item(images[i], None if whole else boxes[i].detach().cpu().float(), cameras[i]))
        except CurviregError as error:
            out.append(named(error, f"image {i}"))
    return out


def _item(image: Any, box: Tensor | None, K: Tensor | None) -> Item:
    pixels = _pixels(image)
    box = whole_image_box(pixels).cpu() if box is None else box
    check_boxes(box[None], [(int(pixels.shape[-2]), int(pixels.shape[-1]))])
    if K is not None:
        check_camera_matrix(K)
    return Item(pixels, box, K)


def _pixels(image: Any) -> Tensor:
    if isinstance(image, str | PathLike):
        return read_photo(image).image  # as viewers show it, as the command line reads it
    if isinstance(image, np.ndarray):
        image = torch.from_numpy(np.ascontiguousarray(image))
        image = image[None] if image.ndim == 2 else image.movedim(-1, 0) if image.ndim == 3 else image
    if not isinstance(image, Tensor):
        raise InvalidInputError(f"expected a tensor, an array or a path, got {type(image).__name__}")
    if image.ndim != 3 or image.shape[0] not in (1, 3) or 0 in image.shape:
        raise InvalidInputError(
            f"expected 1 (grey) or 3 (RGB) channels in shape (C, H, W) (arrays: (H, W, C)), got {tuple(image.shape)}"
        )
    if image.dtype != torch.uint8 and not image.is_floating_point():
        raise InvalidInputError(f"expected uint8, or floating in [0, 1], got {image.dtype}")
    return image


def check_crop(crop: Tensor) -> None:
    """Raise :class:`ImageError` for a (C, S, S) crop in which there is nothing to register."""
    if not bool(crop.isfinite().all()):
        raise ImageError("NaN or inf in the pixels of the box; repair the image, or give another")
    if float(crop.amax()) > 1.0 + 1e-3 or float(crop.amin()) < -1e-3:
        raise ImageError("pixels outside [0, 1]; divide floating images by 255, or give them as uint8")
    if float(crop.amax() - crop.amin()) < 1.0 / 255.0:
        raise ImageError("the box shows one colour, nothing to register; check image and box")


def named(error: CurviregError, name: str) -> CurviregError:
    """The same error, saying which photograph it is about."""
    return type(error)(f"{name}: {error}")
