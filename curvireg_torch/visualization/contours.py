"""Contours of a rendered mesh as anti-aliased lines with a dark rim, which show on any background."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ..rendering import DepthRenderer
from .encoding import to_uint8

OUTLINE, CREASE, BOX, RIM = (0, 255, 80), (255, 170, 0), (255, 255, 255), (0, 0, 0)
RIM_OPACITY = 0.7  # of the black rim
JUMP = 0.03  # step at an occluding edge inside the outline, as a fraction of the depth range
CREASE_ANGLE = np.deg2rad(25.0)  # least angle between the faces at a crease, in the section along a row or a column
SMOOTH, SHORT = 0.01, 0.06  # fractions of the object's size: over which faces are averaged; of the shortest inner edge


def line_width(size: Sequence[int]) -> float:
    """Width of the outline in px in a picture of ``size`` (H, W)."""
    return max(1.5, max(size) / 350)


def close_up(size: Sequence[int], box: Sequence[float]) -> tuple[int, int, int, int]:
    """A square window around a box in px with a margin, moved into a photograph of ``size`` (H, W) and cut there."""
    (H, W), (x0, y0, x1, y1) = size, box
    side = round(1.3 * max(x1 - x0, y1 - y0)) + 2
    left = max(0, min(round(0.5 * (x0 + x1 - side)), W - side))
    top = max(0, min(round(0.5 * (y0 + y1 - side)), H - side))
    return left, top, min(W, left + side), min(H, top + side)


def draw_window(
    renderer: DepthRenderer,
    projection: tuple[Tensor, Tensor] | None,
    image: Tensor,
    window: Sequence[int],
    scale: float,
    box: Sequence[float] | None = None,
) -> np.ndarray:
    """(H', W', 3) uint8 RGB: part of a (1 or 3, H, W) photograph with a mesh's contours, and a box in px below them.

    ``projection`` is ``T_cam_from_model`` (4, 4) and the camera matrix (3, 3); None draws no mesh. ``window`` is x0,
    y0, x1, y1 without the last column and row, and is resized by ``scale``.
    """
    x0, y0, x1, y1 = window
    picture = to_uint8(image[:, y0:y1, x0:x1])
    if scale != 1.0:
        size = max(1, round((x1 - x0) * scale)), max(1, round((y1 - y0) * scale))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC))
    fx, fy = picture.shape[1] / (x1 - x0), picture.shape[0] / (y1 - y0)
    moved = [[fx, 0.0, fx * (0.5 - x0) - 0.5], [0.0, fy, fy * (0.5 - y0) - 0.5], [0.0, 0.0, 1.0]]  # of pixel centres
    resize = torch.tensor(moved, dtype=torch.float64)
    if box is not None:
        corners = resize @ torch.tensor([[box[0], box[2]], [box[1], box[3]], [1.0, 1.0]], dtype=torch.float64)
        start, end = corners[:2].mT.round().int().tolist()
        width = max(1, round(line_width(picture.shape[:2]) / 3))
        for colour, thickness in ((RIM, width + 2), (BOX, width)):
            cv2.rectangle(picture, start, end, colour, thickness)
    if projection is not None:
        T, K = projection
        K = resize @ K.cpu().double()
        layer = contour_layer(renderer.render(T[None], K, picture.shape[:2])[0, 0], K)
        drawn = layer[..., 3] > 0
        alpha = layer[drawn][:, 3:] / 255.0
        picture[drawn] = np.round(alpha * layer[drawn][:, :3] + (1.0 - alpha) * picture[drawn])
    return picture


def contour_layer(depth: Tensor, camera_matrix: Tensor) -> np.ndarray:
    """Outline (green), occluding edges and creases (orange) of a depth view, on a transparent layer.

    ``depth`` (H, W) is 0 in the background; the result is (H, W, 4) uint8 RGBA.
    """
    z = depth.cpu().float().numpy()
    layer = np.zeros((*z.shape, 4), np.uint8)
    rows, columns = np.nonzero(z.any(axis=1))[0], np.nonzero(z.any(axis=0))[0]
    if len(rows) == 0:
        return layer
    width = line_width(z.shape)
    margin = int(3 * width) + 2
    near = np.s_[
        max(0, rows[0] - margin) : rows[-1] + margin + 1, max(0, columns[0] - margin) : columns[-1] + margin + 1
    ]
    outline, inner = _edges(z[near], camera_matrix.diagonal()[:2].tolist())
    to_outline, to_inner = _distance(outline), _distance(inner)
    green, orange = _coverage(to_outline, width / 2), _coverage(to_inner, max(0.75, width / 3))
    dark = RIM_OPACITY * np.maximum(_coverage(to_outline, width), _coverage(to_inner, 0.85 * width))
    colour, alpha = np.zeros((*outline.shape, 3), np.float32), dark
    for paint, cover in ((CREASE, orange), (OUTLINE, green)):
        colour += cover[..., None] * (np.array(paint, np.float32) - colour)
        alpha = cover + (1 - cover) * alpha
    layer[near][..., :3] = np.round(colour / np.maximum(alpha, 1e-6)[..., None])
    layer[near][..., 3] = np.round(255 * alpha)
    return layer


def _distance(lines: np.ndarray) -> np.ndarray:
    """Distance of each pixel to the nearest pixel of the lines, smoothed so that stairs become slopes."""
    if not lines.any():
        return np.full(lines.shape, np.inf, np.float32)
    distance = cv2.distanceTransform((~lines).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    blurred = np.asarray(cv2.GaussianBlur(distance, (0, 0), 0.8))
    return blurred - np.float32(0.5)  # about 0 on the line again


def _coverage(distance: np.ndarray, reach: float) -> np.ndarray:
    return np.asarray(np.clip(reach + 0.5 - distance, 0.0, 1.0))


def _edges(z: np.ndarray, focal: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (H, W) on the outline, and on occluding edges and creases inside it."""
    mask = z > 0
    inside = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    size = max(mask.any(axis=0).sum(), mask.any(axis=1).sum())
    window, limit = max(2, round(SMOOTH * size)), JUMP * float(np.ptp(z[mask]))
    rows = _jumps(z, limit) & inside | _creases(z, focal[0], window, limit)
    columns = _jumps(z.T, limit) & inside.T | _creases(np.ascontiguousarray(z.T), focal[1], window, limit)
    return mask & ~inside, _long(rows | columns.T, SHORT * size)


def _jumps(z: np.ndarray, limit: float) -> np.ndarray:
    """Steps along the rows larger than a neighbouring one by ``limit``: on a steep face all steps are equal."""
    step = np.abs(np.diff(z, axis=1))
    padded = np.pad(step, [(0, 0), (1, 1)], mode="edge")
    return np.pad(step - np.minimum(padded[:, :-2], padded[:, 2:]) > limit, [(0, 0), (0, 1)])


def _creases(z: np.ndarray, focal: float, window: int, limit: float) -> np.ndarray:
    """Where the surface's mean direction changes along the rows from one ``window`` of px to the next."""
    inverse = 1.0 / np.where(z > 0, z, 1.0)  # linear in px across a plane
    step, middle = np.diff(inverse, axis=1), 0.5 * (inverse[:, 1:] + inverse[:, :-1])
    connected = (z[:, 1:] > 0) & (z[:, :-1] > 0) & (np.abs(np.diff(z, axis=1)) < limit)
    direction = np.where(connected, np.arctan(focal * step / middle), 0.0)
    kernel = np.repeat([-1.0, 1.0], window)[None] / window  # no window reaches across an occluding edge
    whole = cv2.erode(connected.astype(np.uint8), np.ones(kernel.shape), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    change = np.abs(cv2.filter2D(direction, -1, kernel)) * whole
    peak = cv2.dilate(change, np.ones((1, 2 * window + 1)))
    return np.pad((change >= peak) & (change > CREASE_ANGLE), [(0, 0), (0, 1)])


def _long(lines: np.ndarray, least: float) -> np.ndarray:
    """Lines without their parts that are shorter than ``least`` px: bumps of rough meshes."""
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(lines.astype(np.uint8), connectivity=8)
    extent = boxes[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1)
    return np.asarray(lines & (extent >= least)[labels])
