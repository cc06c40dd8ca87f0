"""The contours that were fitted, as anti-aliased lines with a dark rim, which show on any
background."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import torch
from torch import Tensor

from ..geometry.cameras import boxes_of, projected
from ..geometry.crops import crop_transforms, square_boxes
from ..matching import ViewDescriber
from ..rendering.contours import LEVELS
from ..utils.arrays import Bytes, Flags, Floats, Singles
from ..utils.precision import full_precision
from .encoding import rescaled, to_uint8

OUTLINE = (0, 255, 80)
CREASE = (255, 170, 0)
BOX = (255, 255, 255)
AXIS = (70, 190, 255)
RIM = (0, 0, 0)
RIM_OPACITY = 0.7  # of the black rim
# Side in px of the crop in which contours are found, as in the last rounds of a fit
FIT_SIZE = LEVELS[-1][0]
# Side of the object in px of the picture for which a fit's number of points would be drawn without
# gaps
SIDE_WITHOUT_GAPS = 20.0
MAX_DENSITY = 80.0  # Largest multiple of a fit's number of points
# Shortest inner edge that is drawn, as a fraction of the object's size: rough meshes have bumps of
# all directions
SHORT = 0.06


@dataclass(frozen=True)
class Drawn:
    """What is drawn of an object: a mesh, by its describer, at ``T_cam_from_model`` (4, 4) with the
    camera matrix (3, 3); a box in px below it, and an arrow from the start to the end of ``axis``
    (2, 3) in the model's frame, unless these are None."""

    describer: ViewDescriber
    projection: tuple[Tensor, Tensor]
    box: Sequence[float] | None = None
    axis: Tensor | None = None


def _line_width(size: Sequence[int]) -> float:
    """Width of the outline in px in a picture of ``size`` (H, W)."""
    return max(1.5, max(size) / 350)


def close_up(size: Sequence[int], box: Sequence[float]) -> tuple[int, int, int, int]:
    """A square window around a box in px with a margin, moved into a photograph of ``size`` (H, W)
    and cut there."""
    H, W = size
    x0, y0, x1, y1 = box
    side = round(1.3 * max(x1 - x0, y1 - y0)) + 2
    left = max(0, min(round(0.5 * (x0 + x1 - side)), W - side))
    top = max(0, min(round(0.5 * (y0 + y1 - side)), H - side))
    return left, top, min(W, left + side), min(H, top + side)


def draw_close_up(
    image: Tensor, box: Sequence[float], side: float, objects: Sequence[Drawn]
) -> Bytes:
    """:func:`draw_window` around a box, at most ``side`` px wide and high."""
    window = close_up(image.shape[-2:], box)
    x0, y0, x1, y1 = window
    return draw_window(image, window, side / max(x1 - x0, y1 - y0), objects)


@full_precision()
def draw_window(
    image: Tensor, window: Sequence[int], scale: float, objects: Sequence[Drawn]
) -> Bytes:
    """(H', W', 3) uint8 RGB: part of a (1 or 3, H, W) photograph with the contours of objects.

    ``window`` is x0, y0, x1, y1 without the last column and row, and is resized by ``scale``.
    """
    x0, y0, x1, y1 = window
    picture = rescaled(to_uint8(image[:, y0:y1, x0:x1]), scale)
    fx = picture.shape[1] / (x1 - x0)
    fy = picture.shape[0] / (y1 - y0)
    # of pixel centres
    moved = [[fx, 0.0, fx * (0.5 - x0) - 0.5], [0.0, fy, fy * (0.5 - y0) - 0.5], [0.0, 0.0, 1.0]]
    resize = torch.tensor(moved, dtype=torch.float64)
    for each in objects:
        if each.box is not None:
            left, top, right, bottom = each.box
            corners = torch.tensor([[left, right], [top, bottom], [1.0, 1.0]]).double()
            thickness = _line_width(picture.shape[:2]) / 3
            _draw_rimmed(cv2.rectangle, picture, (resize @ corners)[:2].mT, BOX, thickness)
        T, K = (x.cpu().double() for x in each.projection)
        _paint(picture, contour_layer(each.describer, T, resize @ K, picture.shape[:2]))
        if each.axis is not None:
            _draw_axis(picture, each.axis.to(T), T, resize @ K)
    return picture


def _draw_axis(picture: Bytes, ends: Tensor, T: Tensor, K: Tensor) -> None:
    """Draw an arrow between ``ends`` (2, 3) of the model; ``K`` (3, 3) has px of the picture."""
    if (ends @ T[2, :3] + T[2, 3]).min() > 0.0:
        arrow = partial(cv2.arrowedLine, line_type=cv2.LINE_AA, tipLength=0.08)
        thickness = max(2, _line_width(picture.shape[:2]))
        _draw_rimmed(arrow, picture, projected(ends, T, K), AXIS, thickness)


def _draw_rimmed(
    draw: Callable[..., object],
    picture: Bytes,
    ends: Tensor,
    colour: tuple[int, int, int],
    thickness: float,
) -> None:
    """Draw what extends between two points (2, 2), with a dark rim."""
    start, end = ends.round().int().tolist()
    width = max(1, round(thickness))
    draw(picture, start, end, RIM, width + 2)
    draw(picture, start, end, colour, width)


def _paint(picture: Bytes, layer: Bytes) -> None:
    """Paint an (H, W, 4) layer over an (H, W, 3) picture."""
    is_drawn = layer[..., 3] > 0
    alpha = layer[is_drawn][:, 3:] / 255.0
    paint = layer[is_drawn][:, :3]
    picture[is_drawn] = np.round(alpha * paint + (1.0 - alpha) * picture[is_drawn])


def contour_layer(describer: ViewDescriber, T: Tensor, K: Tensor, size: Sequence[int]) -> Bytes:
    """Outline (green), inner occluding edges and creases (orange) of a mesh at a pose, on a
    transparent layer.

    Args:
        describer: of the mesh.
        T, K: (4, 4) ``T_cam_from_model`` and (3, 3) camera matrix in px of the layer.
        size: (H, W) of the layer.

    Returns:
        (H, W, 4) uint8 RGBA.
    """
    layer = np.zeros((*size, 4), np.uint8)
    pixels, is_outline = contour_pixels(describer, T, K, size)
    outline = _mask(pixels[is_outline], size)
    object_size = float(np.ptp(pixels, axis=0).max(initial=0.0)) if len(pixels) else 0.0
    inner = _long_lines(_mask(pixels[~is_outline], size), SHORT * object_size) & ~outline
    x, y, across, down = cv2.boundingRect((outline | inner).astype(np.uint8))
    if not across:
        return layer
    width = _line_width(size)
    margin = int(3 * width) + 2
    near = np.s_[max(0, y - margin) : y + down + margin, max(0, x - margin) : x + across + margin]
    to_outline = _distance(outline[near])
    to_inner = _distance(inner[near])
    green = _coverage(to_outline, width / 2)
    orange = _coverage(to_inner, max(0.75, width / 3))
    alpha = RIM_OPACITY * np.maximum(
        _coverage(to_outline, width), _coverage(to_inner, 0.85 * width)
    )
    colour = np.zeros((*alpha.shape, 3), np.float32)
    for paint, cover in ((CREASE, orange), (OUTLINE, green)):
        colour += cover[..., None] * (np.array(paint, np.float32) - colour)
        alpha = cover + (1 - cover) * alpha
    layer[near][..., :3] = np.round(colour / np.maximum(alpha, 1e-6)[..., None])
    layer[near][..., 3] = np.round(255 * alpha)
    return layer


def contour_pixels(
    describer: ViewDescriber, T: Tensor, K: Tensor, size: Sequence[int]
) -> tuple[Floats, Flags]:
    """Pixels (P, 2) of the contours that a fit compares at a pose, and which of them are on the
    outline (P,) bool.

    They are found in the crop of the projected mesh, as in the last rounds of a fit, or in the
    picture of ``size`` (H, W) if a part of the mesh is behind the camera, with as many points as a
    line without gaps needs.
    """
    pose = T[None].double().cpu()
    K = K.double().cpu()
    depth = describer.hull @ pose[0, 2, :3] + pose[0, 2, 3]
    if (depth > 0).all():
        box = boxes_of(describer.hull, pose, K)
    else:
        box = torch.tensor([[0.0, 0.0, size[1], size[0]]], dtype=torch.float64)
    crop_camera = crop_transforms(square_boxes(box, describer.settings.margin), FIT_SIZE) @ K
    side = float((box[0, 2:] - box[0, :2]).max())
    density = min(max(side / SIDE_WITHOUT_GAPS, 1.0), MAX_DENSITY)
    points = describer.contours.points(pose, crop_camera, FIT_SIZE, density=density)
    is_point = points.valid[0]
    pixels = projected(points.model[0, is_point], pose, K)[0]
    return pixels.numpy(), points.outline[0, is_point].numpy()


def _mask(pixels: Floats, size: Sequence[int]) -> Flags:
    """(H, W) bool: the pixels in which points (P, 2) lie; points outside are left out."""
    mask = np.zeros(tuple(size), bool)
    columns, rows = np.round(pixels).astype(np.int64).T
    is_inside = (rows >= 0) & (rows < size[0]) & (columns >= 0) & (columns < size[1])
    mask[rows[is_inside], columns[is_inside]] = True
    return mask


def _long_lines(lines: Flags, least: float) -> Flags:
    """Lines (H, W) without their parts that are shorter than ``least`` px; points at most two px
    apart are a line."""
    connected = cv2.dilate(lines.astype(np.uint8), np.ones((3, 3), np.uint8))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(connected, connectivity=8)
    extent = boxes[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) - 2
    return np.asarray(lines & (extent >= least)[labels])


def _distance(lines: Flags) -> Singles:
    """Distance of each pixel to the nearest pixel of the lines, smoothed so that stairs become
    slopes."""
    if not lines.any():
        return np.full(lines.shape, np.inf, np.float32)
    distance = cv2.distanceTransform((~lines).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    blurred = np.asarray(cv2.GaussianBlur(distance, (0, 0), 0.8))
    return blurred - np.float32(0.5)  # about 0 on the line again


def _coverage(distance: Singles, reach: float) -> Singles:
    return np.asarray(np.clip(reach + 0.5 - distance, 0.0, 1.0))
