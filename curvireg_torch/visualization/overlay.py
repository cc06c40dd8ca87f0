"""One picture that shows whether a registration is right."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import CurviregError, InvalidInputError
from ..geometry import rotation_error
from ..matching.fields import depth_filter
from ..registration import Hypothesis, Registrar, Registration
from ..registration.inputs import ImageItem, image_items
from ..rendering.protocol import DepthRenderer
from ..terms import crop_regions, photograph_field
from ..utils.checks import as_numbers, check_camera_matrix

__all__ = ["contour_overlay", "registration_sheet", "side_pictures"]

_CONTOUR, _INNER, _BOX = (0, 255, 80), (255, 170, 0), (255, 255, 255)
_TILE = 192
_Window = tuple[int, int, int, int]


def contour_overlay(
    registrar: Registrar, result: Registration | Hypothesis, image: Any, box: Any, camera_matrix: Any | None = None
) -> np.ndarray:
    """The photograph with the mesh's outer (green) and inner (orange) contours at the pose, and the box (white).

    Args:
        registrar, result: the result of this registrar, or one of its hypotheses; it is drawn with its ``projection``.
        image, box: the photograph, as the registrar takes it: a (1 or 3, H, W) tensor, an array or a path; (4,) px.
        camera_matrix: (3, 3), if ``image`` is another one from the same position, such as a smaller copy.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        InvalidInputError: a camera matrix, but a pose without translation.
    """
    item = _item(image, box)
    H, W = item.image.shape[-2:]
    return _overlay(registrar, result, item, (0, 0, W, H), camera_matrix)


def _overlay(
    registrar: Registrar, result: Registration | Hypothesis, item: ImageItem, window: _Window, camera_matrix: Any | None
) -> np.ndarray:
    """:func:`contour_overlay` of columns x0 to x1 - 1 and rows y0 to y1 - 1."""
    x0, y0, x1, y1 = window
    T, K = result.projection
    if camera_matrix is not None:
        if result.translation is None:
            raise InvalidInputError("camera_matrix: the pose was found without one; leave it out")
        K = as_numbers(camera_matrix, "camera_matrix", dtype=torch.float64)
        check_camera_matrix(K)
    K = K.clone()
    K[:2, 2] -= K.new_tensor([x0, y0])
    picture = to_uint8(item.image[:, y0:y1, x0:x1])
    box = (item.box - item.box.new_tensor([x0, y0, x0, y0])).tolist()
    draw_pose(picture, registrar.describers[result.model].renderer, (T, K), box)
    return picture


def _window(item: ImageItem) -> _Window:
    """The box with a margin of half its longer side, inside the photograph."""
    H, W = item.image.shape[-2:]
    x0, y0, x1, y1 = item.box.tolist()
    margin = 0.5 * max(x1 - x0, y1 - y0)
    left, top = max(0, round(x0 - margin)), max(0, round(y0 - margin))
    return left, top, min(W, round(x1 + margin)), min(H, round(y1 + margin))


def draw_pose(
    picture: np.ndarray, renderer: DepthRenderer, projection: tuple[Tensor, Tensor], box: Sequence[float]
) -> None:
    """Draw a mesh's contours and a box into (H, W, 3) uint8; ``projection`` is pose and camera matrix."""
    T, K = projection
    width = draw_contours(picture, renderer.render(T[None], K, picture.shape[:2])[0, 0].cpu().numpy())
    x0, y0, x1, y1 = (round(v) for v in box)
    cv2.rectangle(picture, (x0, y0), (x1, y1), _BOX, max(1, width // 2))


def draw_contours(picture: np.ndarray, depth: np.ndarray) -> int:
    """Draw outer and inner contours of (H, W) depth into an (H, W, 3 or 4) picture; returns the line width in px."""
    width = max(1, round(max(int(n) for n in depth.shape) / 500))
    opaque = (255,) * (picture.shape[2] - 3)
    x, y, w, h = cv2.boundingRect((depth > 0).astype(np.uint8))
    margin = width + 2  # nothing is drawn or looked at farther from the mesh
    window = np.s_[max(0, y - margin) : y + h + margin, max(0, x - margin) : x + w + margin]
    depth, picture = depth[window], picture[window]
    mask = (depth > 0).astype(np.uint8)
    inner = _depth_edges(depth) & (cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0)
    thick = cv2.dilate(inner.astype(np.uint8), np.ones((width, width), np.uint8)) > 0
    picture[thick] = (*_INNER, *opaque)
    outline, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outline, -1, (*_CONTOUR, *opaque), width)
    return width


def _item(image: Any, box: Any) -> ImageItem:
    item = image_items([image], as_numbers(box, "box")[None], None)[0]
    if isinstance(item, CurviregError):
        raise item
    return item


def _depth_edges(depth: np.ndarray) -> np.ndarray:
    """Depth discontinuities inside the silhouette: steps larger than a neighbouring one by 3 % of the depth range."""
    mask = depth > 0
    if not mask.any():
        return mask
    limit = 0.03 * float(np.ptp(depth[mask]))
    edges = np.zeros_like(mask)
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis))
        padded = np.pad(step, [(1, 1), (0, 0)] if axis == 0 else [(0, 0), (1, 1)], mode="edge")
        before, after = (np.take(padded, range(k, k + step.shape[axis]), axis=axis) for k in (0, 2))
        jump = step - np.minimum(before, after) > limit
        edges |= np.pad(jump, [(0, 1), (0, 0)] if axis == 0 else [(0, 0), (0, 1)])
    return np.asarray(edges & mask)


@torch.no_grad()
def registration_sheet(
    registrar: Registrar, result: Registration, image: Any, box: Any, camera_matrix: Any | None = None
) -> np.ndarray:
    """Contour overlay; beside it crop, field, pose and its field; below the hypotheses, best first.

    The overlay shows the box with a margin of half its longer side. The caption of a hypothesis is its score and its
    rotation from the best. Arguments as for :func:`contour_overlay`; returns (H', W', 3) uint8 RGB.
    """
    item = _item(image, box)
    overlay = _overlay(registrar, result, item, _window(item), camera_matrix)
    side = [_tile(p, name) for name, p in side_pictures(registrar, result, item.image, item.box).items()]
    poses = [
        _tile(depth_picture(_depth(registrar, h)[0, 0]), _hypothesis_caption(registrar, result, i))
        for i, h in enumerate(result.hypotheses, start=1)
    ]
    panel = np.vstack([np.hstack(side[:2]), np.hstack(side[2:])])
    scale = (height := panel.shape[0]) / overlay.shape[0]
    shrink = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    overlay = cv2.resize(overlay, (max(1, round(overlay.shape[1] * scale)), height), interpolation=shrink)
    rows = [np.hstack([overlay, panel]), np.hstack(poses)]
    width = max(row.shape[1] for row in rows)
    return np.vstack([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])


@torch.no_grad()
def side_pictures(
    registrar: Registrar, result: Registration | Hypothesis, image: Any, box: Any
) -> dict[str, np.ndarray]:
    """(S, S, 3) uint8 RGB each of "photograph", "photograph field", "pose" and "view field".

    Arguments as for :func:`contour_overlay`.
    """
    item = _item(image, box)
    settings = registrar.bank.settings
    crop = crop_regions([item.image], item.box[None, None], size=settings.image_size, margin=settings.margin)[0]
    field = photograph_field(registrar.matcher.field, crop.to(registrar.bank.device))
    depth = _depth(registrar, result)
    return {
        "photograph": to_uint8(crop[0]),
        "photograph field": _field_picture(field[0]),
        "pose": depth_picture(depth[0, 0]),
        "view field": _field_picture(depth_filter(settings)(depth)[0]),
    }


def _depth(registrar: Registrar, pose: Registration | Hypothesis) -> Tensor:
    """(1, 1, S, S) depth of a pose, as the bank's views are rendered."""
    return registrar.describers[pose.model].depth(pose.allocentric_rotation[None], torch.tensor([pose.distance]))[0]


def _hypothesis_caption(registrar: Registrar, result: Registration, number: int) -> str:
    best, this = result.hypotheses[0], result.hypotheses[number - 1]
    mesh = f"mesh {this.model}, " if len(registrar.bank.meshes) > 1 else ""
    if number == 1 or this.model != best.model:
        return f"{number}: {mesh}score {this.score:.2f}"
    return f"{number}: {mesh}score {this.score:.2f}, {float(rotation_error(this.rotation, best.rotation)):.0f} deg"


def to_uint8(image: Tensor) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a (1 or 3, H, W) image, floating in [0, 1] or uint8; black for NaN."""
    pixels = image.detach().cpu()
    if pixels.is_floating_point():
        pixels = (pixels.float().nan_to_num(0.0, 0.0, 0.0).clamp(0, 1) * 255).round().byte()
    return np.ascontiguousarray(pixels.expand(3, -1, -1).permute(1, 2, 0).numpy())


def depth_picture(depth: Tensor) -> np.ndarray:
    """(H, W, 3) uint8 of a (H, W) depth image: near is bright, background black."""
    mask = depth > 0
    if not bool(mask.any()):
        return to_uint8(torch.zeros_like(depth)[None])
    near, far = depth[mask].aminmax()
    shade = 1.0 - 0.75 * (depth - near) / (far - near).clamp(min=1e-9)
    return to_uint8((shade * mask)[None])


def _field_picture(field: Tensor) -> np.ndarray:
    length = field.float().norm(dim=0, keepdim=True)
    return to_uint8((length / length.max().clamp(min=1e-12)).sqrt())


def _tile(picture: np.ndarray, text: str) -> np.ndarray:
    picture = np.asarray(cv2.resize(picture, (_TILE, _TILE), interpolation=cv2.INTER_AREA))
    for colour, width in (((0, 0, 0), 3), ((255, 255, 0), 1)):
        cv2.putText(picture, text, (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, width, cv2.LINE_AA)
    return picture
