"""One picture that shows whether a registration is right."""

from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..matching.describe import depth_filter
from ..registration import Hypothesis, Registrar, Registration
from ..registration.inputs import ImageItem, image_item
from ..terms import crop_regions, photograph_field
from ..utils.checks import as_numbers, check_camera_matrix
from .contours import draw_pose

__all__ = ["contour_overlay", "side_pictures"]

Window = tuple[int, int, int, int]


def contour_overlay(
    registrar: Registrar, result: Registration | Hypothesis, image: Any, box: Any, camera_matrix: Any | None = None
) -> np.ndarray:
    """The photograph with the mesh's outline (green), its inner edges (orange) at the pose, and the box (white).

    Args:
        registrar, result: the result of this registrar, or one of its hypotheses; it is drawn with its ``projection``.
        image, box: the photograph, as the registrar takes it: a (1 or 3, H, W) tensor, an array or a path; (4,) px.
        camera_matrix: (3, 3), if ``image`` is another one from the same position, such as a smaller copy.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        InvalidInputError: a camera matrix, but a pose without translation.
    """
    item = photograph_item(image, box)
    H, W = item.image.shape[-2:]
    return draw_window(registrar, result, item, (0, 0, W, H), 1.0, camera_matrix)


def draw_window(
    registrar: Registrar,
    result: Registration | Hypothesis,
    item: ImageItem,
    window: Window,
    scale: float,
    camera_matrix: Any | None,
    *,
    box: bool = True,
) -> np.ndarray:
    """:func:`contour_overlay` of columns x0 to x1 - 1 and rows y0 to y1 - 1, resized by ``scale``."""
    x0, y0, x1, y1 = window
    T, K = result.projection
    if camera_matrix is not None:
        if result.translation is None:
            raise InvalidInputError("camera_matrix: the pose was found without one; leave it out")
        K = as_numbers(camera_matrix, "camera_matrix", dtype=torch.float64)
        check_camera_matrix(K)
    picture = to_uint8(item.image[:, y0:y1, x0:x1])
    if scale != 1.0:
        size = max(1, round((x1 - x0) * scale)), max(1, round((y1 - y0) * scale))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC))
    fx, fy = picture.shape[1] / (x1 - x0), picture.shape[0] / (y1 - y0)
    resize = torch.tensor(
        [[fx, 0.0, fx * (0.5 - x0) - 0.5], [0.0, fy, fy * (0.5 - y0) - 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    left, top, right, bottom = item.box.tolist()
    corners = resize @ torch.tensor([[left, right], [top, bottom], [1.0, 1.0]], dtype=torch.float64)
    draw_pose(
        picture, registrar.describer.renderer, (T, resize @ K), corners[:2].mT.flatten().tolist() if box else None
    )
    return picture


def photograph_item(image: Any, box: Any) -> ImageItem:
    return image_item(image, as_numbers(box, "box"))


@torch.no_grad()
def side_pictures(
    registrar: Registrar, result: Registration | Hypothesis, image: Any, box: Any
) -> dict[str, np.ndarray]:
    """(S, S, 3) uint8 RGB each of "photograph", "photograph field", "pose" and "view field".

    Arguments as for :func:`contour_overlay`.
    """
    item = photograph_item(image, box)
    settings = registrar.bank.settings
    crop = crop_regions([item.image], item.box[None, None], size=settings.image_size, margin=settings.margin)[0]
    field = photograph_field(registrar.matcher.field, crop.to(registrar.bank.device))
    rotation, distance = result.allocentric_rotation, result.distance
    depth = registrar.describer.depth(rotation[None], torch.tensor([distance]))[0]
    return {
        "photograph": to_uint8(crop[0]),
        "photograph field": _field_picture(field[0]),
        "pose": view_picture(registrar, rotation, distance),
        "view field": _field_picture(depth_filter(settings)(depth)[0]),
    }


def view_picture(registrar: Registrar, rotation: Tensor, distance: float) -> np.ndarray:
    """(S, S, 3) uint8 RGB of the mesh as the bank's views show it, shaded before a white background."""
    shaded = registrar.describer.shaded(rotation[None], torch.tensor([distance]))[0]
    return to_uint8(shaded[-3:] if len(shaded) > 1 else shaded)  # grey, or grey and RGB


def to_uint8(image: Tensor) -> np.ndarray:
    """(H, W, 3) uint8 RGB, always a copy, of a (1 or 3, H, W) image, floating in [0, 1] or uint8; black for NaN."""
    pixels = image.detach().cpu()
    if pixels.is_floating_point():
        pixels = (pixels.float().nan_to_num(0.0, 0.0, 0.0).clamp(0, 1) * 255).round().byte()
    return np.array(pixels.expand(3, -1, -1).permute(1, 2, 0).numpy(), order="C")


def _field_picture(field: Tensor) -> np.ndarray:
    """Strong edges are dark, on white."""
    length = field.float().norm(dim=0, keepdim=True)
    return to_uint8(1.0 - (length / length.max().clamp(min=1e-12)).sqrt())
