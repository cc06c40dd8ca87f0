"""One picture that shows whether a registration can be believed."""

import cv2
import numpy as np
import torch
from torch import Tensor

from ..geometry.crops import crop_transforms, square_boxes
from ..registration import Registrar, Registration

__all__ = ["contour_overlay", "registration_sheet"]

_CONTOUR, _INNER, _BOX = (0, 255, 80), (255, 170, 0), (255, 255, 255)
_TILE = 192


def contour_overlay(
    registrar: Registrar, result: Registration, image: Tensor, box: Tensor, camera_matrix: Tensor | None = None
) -> np.ndarray:
    """The photograph with the mesh's outer (green) and inner (orange) contours at the pose, and the box (white).

    Args:
        registrar: what made ``result``.
        image: (1 or 3, H, W) in [0, 1].
        box: (4,) px.
        camera_matrix: (3, 3), as given to the registrar.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    H, W = image.shape[-2:]
    if camera_matrix is not None and result.transform is not None:
        T, K = result.transform, camera_matrix.double().cpu()
    else:
        distance = torch.tensor([result.distance], dtype=torch.float64)
        cameras, crops, _ = registrar.describers[result.model].cameras(result.allocentric_rotation[None], distance)
        settings = registrar.bank.settings
        to_crop = crop_transforms(square_boxes(box.double().cpu(), settings.margin), settings.image_size)
        T, K = cameras[0], torch.linalg.inv(to_crop).triu() @ crops[0]
    orthographic = registrar.bank.settings.camera == "orthographic" and camera_matrix is None
    renderer = registrar.describers[result.model].renderer
    depth = renderer.render(T[None], K, (H, W), orthographic=orthographic)[0, 0].cpu().numpy()
    picture = to_uint8(image)
    width = max(1, round(max(H, W) / 500))
    mask = (depth > 0).astype(np.uint8)
    inner = _depth_edges(depth) & (cv2.erode(mask, np.ones((3, 3), np.uint8)) > 0)
    picture[_thick(inner, width)] = _INNER
    outline, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outline, -1, _CONTOUR, width)
    corners = [round(float(v)) for v in box]
    cv2.rectangle(picture, (corners[0], corners[1]), (corners[2], corners[3]), _BOX, max(1, width // 2))
    return picture


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


def registration_sheet(
    registrar: Registrar, result: Registration, image: Tensor, box: Tensor, camera_matrix: Tensor | None = None
) -> np.ndarray:
    """Contour overlay; beside it the crop, its field, the best view and its field; below the best distinct views.

    Arguments as for :func:`contour_overlay`.

    Returns:
        (H', W', 3) uint8 RGB.
    """
    crop = registrar.matcher.crop(image[None], box[None])[0]
    field = registrar.matcher.features(crop).field[0]
    rotations = [result.allocentric_rotation, *registrar.bank.rotations[result.candidates].double().cpu()]
    distances = [result.distance] + [result.distance] * len(result.candidates)
    depth, _ = registrar.describers[result.model].depth(
        torch.stack(rotations), torch.tensor(distances, dtype=torch.float64)
    )
    view_field = registrar.bank.settings.depth_filter()(depth[:1])[0]
    side = [
        _caption(_tile(to_uint8(crop[0])), "photograph"),
        _caption(_tile(_field_picture(field)), "photograph field"),
        _caption(_tile(depth_picture(depth[0, 0])), "pose"),
        _caption(_tile(_field_picture(view_field)), "view field"),
    ]
    views = [
        _caption(
            _tile(depth_picture(depth[1 + i, 0])), f"{i + 1}: view {int(v)}  {float(result.ranking.scores[0, v]):.2f}"
        )
        for i, v in enumerate(result.candidates)
    ]
    panel = np.vstack([np.hstack(side[:2]), np.hstack(side[2:])])
    overlay = contour_overlay(registrar, result, image, box, camera_matrix)
    height = panel.shape[0]
    scale = height / overlay.shape[0]
    shrink = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    overlay = cv2.resize(overlay, (max(1, round(overlay.shape[1] * scale)), height), interpolation=shrink)
    top, bottom = np.hstack([overlay, panel]), np.hstack(views)
    width = max(top.shape[1], bottom.shape[1])
    return np.vstack([_widen(top, width), _widen(bottom, width)])


def to_uint8(image: Tensor) -> np.ndarray:
    """(H, W, 3) uint8 RGB of a (1 or 3, H, W) image in [0, 1]."""
    pixels = (image.detach().cpu().float().clamp(0, 1) * 255).round().byte().expand(3, -1, -1)
    return np.ascontiguousarray(pixels.permute(1, 2, 0).numpy())


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
