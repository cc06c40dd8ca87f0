"""One picture that shows whether a registration can be believed."""

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
from ..utils.checks import as_numbers, check_camera_matrix

__all__ = ["contour_overlay", "registration_sheet", "side_pictures"]

_CONTOUR, _INNER, _BOX = (0, 255, 80), (255, 170, 0), (255, 255, 255)
_TILE = 192


def contour_overlay(
    registrar: Registrar,
    result: Registration | Hypothesis,
    image: Any,
    box: Any,
    camera_matrix: Any | None = None,
) -> np.ndarray:
    """The photograph with the mesh's outer (green) and inner (orange) contours at the pose, and the box (white).

    What is drawn is what was found (``result.projection``), not what would fill the box.

    Args:
        registrar: what made ``result``.
        result: a registration, or one of its hypotheses.
        image: the photograph, as the registrar takes it: a (1 or 3, H, W) tensor, an array or a path.
        box: (4,) px.
        camera_matrix: (3, 3) of another camera in the same place, for instance of a smaller copy of the photograph;
            default that of the photograph.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        InvalidInputError: a camera matrix for a pose that was found without one.
    """
    item = _item(image, box)
    H, W = item.image.shape[-2:]
    return _overlay(registrar, result, item, camera_matrix, (0, 0, W, H))


def _overlay(
    registrar: Registrar,
    result: Registration | Hypothesis,
    item: ImageItem,
    camera_matrix: Any | None,
    part: tuple[int, int, int, int],
) -> np.ndarray:
    """:func:`contour_overlay` of columns x0 to x1 - 1 and rows y0 to y1 - 1."""
    if camera_matrix is not None and result.translation is None:
        raise InvalidInputError("camera_matrix: the pose was found without one; leave it out")
    x0, y0, x1, y1 = part
    T, K = result.projection
    if camera_matrix is not None:
        K = as_numbers(camera_matrix, "camera_matrix", least=torch.float64)
        check_camera_matrix(K)
    K = K.clone()
    K[:2, 2] -= K.new_tensor([x0, y0])
    picture = to_uint8(item.image[:, y0:y1, x0:x1])
    box = (item.box - item.box.new_tensor([x0, y0, x0, y0])).tolist()
    draw_pose(picture, registrar.describers[result.model].renderer, (T, K), box)
    return picture


def _around(item: ImageItem) -> tuple[int, int, int, int]:
    """The part of a photograph that holds the box and half of its longer side on every side."""
    H, W = item.image.shape[-2:]
    x0, y0, x1, y1 = item.box.tolist()
    room = 0.5 * max(x1 - x0, y1 - y0)
    return max(0, round(x0 - room)), max(0, round(y0 - room)), min(W, round(x1 + room)), min(H, round(y1 + room))


def draw_pose(
    picture: np.ndarray, renderer: DepthRenderer, projection: tuple[Tensor, Tensor], box: Sequence[float]
) -> None:
    """Draw a mesh's contours, seen by (4, 4) ``T_cam_from_model`` and (3, 3) camera, and a box into (H, W, 3) uint8."""
    T, K = projection
    H, W = picture.shape[:2]
    width = draw_contours(picture, renderer.render(T[None], K, (H, W))[0, 0].cpu().numpy())
    x0, y0, x1, y1 = (round(v) for v in box)
    cv2.rectangle(picture, (x0, y0), (x1, y1), _BOX, max(1, width // 2))


def draw_contours(picture: np.ndarray, depth: np.ndarray) -> int:
    """Draw the outer and inner contours of a (H, W) depth image into an (H, W, 3 or 4) picture; returns their width."""
    width = max(1, round(max(int(n) for n in depth.shape) / 500))
    opaque = (255,) * (picture.shape[2] - 3)
    mask = (depth > 0).astype(np.uint8)
    inner = _depth_edges(depth) & (cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0)
    picture[_thick(inner, width)] = (*_INNER, *opaque)
    outline, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outline, -1, (*_CONTOUR, *opaque), width)
    return width


def _item(image: Any, box: Any) -> ImageItem:
    item = image_items([image], as_numbers(box, "box")[None], None)[0]
    if isinstance(item, CurviregError):
        raise item
    return item


def _depth_edges(depth: np.ndarray) -> np.ndarray:
    """Jumps of depth inside the silhouette: steps that exceed those beside them by 3 % of the object's depth range."""
    seen = depth > 0
    if not seen.any():
        return seen
    limit = 0.03 * float(np.ptp(depth[seen]))
    edges = np.zeros_like(seen)
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis))
        around = np.pad(step, [(1, 1), (0, 0)] if axis == 0 else [(0, 0), (1, 1)], mode="edge")
        before, after = (np.take(around, range(k, k + step.shape[axis]), axis=axis) for k in (0, 2))
        jump = step - np.minimum(before, after) > limit
        edges |= np.pad(jump, [(0, 1), (0, 0)] if axis == 0 else [(0, 0), (0, 1)])
    return np.asarray(edges & seen)


def _thick(mask: np.ndarray, width: int) -> np.ndarray:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((width, width), np.uint8)) > 0)


@torch.no_grad()
def registration_sheet(
    registrar: Registrar, result: Registration, image: Any, box: Any, camera_matrix: Any | None = None
) -> np.ndarray:
    """Contour overlay; beside it the crop, its field, the pose and its field; below the hypotheses' poses, best first.

    The overlay shows the box and half of its longer side on every side, so that contours of a small object are seen,
    too. Over each hypothesis stand its score and how far it is turned from the best. Arguments as for
    :func:`contour_overlay`.

    Returns:
        (H', W', 3) uint8 RGB.
    """
    item = _item(image, box)
    overlay = _overlay(registrar, result, item, camera_matrix, _around(item))
    side = [_caption(_tile(p), name) for name, p in side_pictures(registrar, result, item.image, item.box).items()]
    poses = [
        _caption(_tile(depth_picture(_depth(registrar, h)[0, 0])), _told(registrar, result, i))
        for i, h in enumerate(result.hypotheses, start=1)
    ]
    panel = np.vstack([np.hstack(side[:2]), np.hstack(side[2:])])
    height = panel.shape[0]
    scale = height / overlay.shape[0]
    shrink = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    overlay = cv2.resize(overlay, (max(1, round(overlay.shape[1] * scale)), height), interpolation=shrink)
    top, bottom = np.hstack([overlay, panel]), np.hstack(poses)
    width = max(top.shape[1], bottom.shape[1])
    return np.vstack([_widen(top, width), _widen(bottom, width)])


@torch.no_grad()
def side_pictures(
    registrar: Registrar, result: Registration | Hypothesis, image: Any, box: Any
) -> dict[str, np.ndarray]:
    """What the two sides compare, (S, S, 3) uint8 RGB each: "photograph", "photograph field", "pose", "view field".

    Arguments as for :func:`contour_overlay`.
    """
    item = _item(image, box)
    query = registrar.matcher.query([item.image], item.box[None])
    depth = _depth(registrar, result)
    return {
        "photograph": to_uint8(query.crops[0]),
        "photograph field": _field_picture(query.field[0]),
        "pose": depth_picture(depth[0, 0]),
        "view field": _field_picture(depth_filter(registrar.bank.settings)(depth)[0]),
    }


def _depth(registrar: Registrar, pose: Registration | Hypothesis) -> Tensor:
    """(1, 1, S, S) of the view of a pose."""
    return registrar.describers[pose.model].depth(pose.allocentric_rotation[None], torch.tensor([pose.distance]))[0]


def _told(registrar: Registrar, result: Registration, number: int) -> str:
    """What stands over the picture of a hypothesis."""
    best, this = result.hypotheses[0], result.hypotheses[number - 1]
    mesh = f"mesh {this.model}, " if len(registrar.bank.meshes) > 1 else ""
    if number == 1 or this.model != best.model:
        return f"{number}: {mesh}score {this.score:.2f}"
    return f"{number}: {mesh}score {this.score:.2f}, {float(rotation_error(this.rotation, best.rotation)):.0f} deg"


def to_uint8(image: Tensor) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a (1 or 3, H, W) image, floating in [0, 1] or uint8; black where pixels are missing."""
    pixels = image.detach().cpu()
    if pixels.is_floating_point():
        pixels = (pixels.float().nan_to_num(0.0, 0.0, 0.0).clamp(0, 1) * 255).round().byte()
    return np.ascontiguousarray(pixels.expand(3, -1, -1).permute(1, 2, 0).numpy())


def depth_picture(depth: Tensor) -> np.ndarray:
    """(H, W, 3) uint8 of a (H, W) depth image: near is bright, background black."""
    seen = depth > 0
    if not bool(seen.any()):
        return to_uint8(torch.zeros_like(depth)[None])
    near, far = depth[seen].min(), depth[seen].max()
    shade = 1.0 - 0.75 * (depth - near) / (far - near).clamp(min=1e-9)
    return to_uint8((shade * seen)[None])


def _field_picture(field: Tensor) -> np.ndarray:
    length = field.float().norm(dim=0, keepdim=True)
    return to_uint8((length / length.max().clamp(min=1e-12)).sqrt())


def _tile(picture: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.resize(picture, (_TILE, _TILE), interpolation=cv2.INTER_AREA))


def _caption(picture: np.ndarray, text: str) -> np.ndarray:
    cv2.putText(picture, text, (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(picture, text, (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 0), 1, cv2.LINE_AA)
    return picture


def _widen(picture: np.ndarray, width: int) -> np.ndarray:
    return np.pad(picture, ((0, 0), (0, width - picture.shape[1]), (0, 0)))
