"""What the page shows, as files in memory."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ..geometry.cameras import rotation_towards
from ..registration import Hypothesis, Registrar
from ..rendering.shading import shade
from ..visualization.overlay import depth_picture, draw_contours, to_uint8

__all__ = ["SIDE", "at", "png", "pose_layers", "shown_photograph", "view_pictures"]

SIDE = 1400
"""Longer side of the photograph as the page shows it, in px."""


def png(picture: np.ndarray) -> bytes:
    """A PNG file of (H, W, 3 or 4) uint8 RGB or RGBA."""
    order = cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    return bytes(cv2.imencode(".png", cv2.cvtColor(picture, order))[1].tobytes())


def shown_photograph(image: Tensor) -> tuple[bytes, float]:
    """A JPEG of a (3, H, W) photograph, made smaller where it is large, and its scale."""
    pixels = to_uint8(image)
    scale = min(1.0, SIDE / max(pixels.shape[:2]))
    if scale < 1.0:
        size = max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
    return bytes(data), pixels.shape[1] / image.shape[-1]


def at(centre: Tensor, pose: Hypothesis, T: Tensor) -> Hypothesis:
    """The hypothesis moved to (4, 4) ``T_cam_from_model`` of the camera that saw it; what was measured of it is gone.

    Args:
        centre: (3,) of the object.
    """
    position = T[:3, :3] @ centre + T[:3, 3]
    straight = rotation_towards(position).mT @ T[:3, :3]
    known = pose.translation is not None
    return replace(
        pose,
        rotation=T[:3, :3].clone() if known else straight,
        translation=T[:3, 3].clone() if known else None,
        score=float("nan"),
        evidence={},
        allocentric_rotation=straight,
        distance=float(torch.linalg.vector_norm(position)),
        projection=(T, pose.projection[1]),
        edge_support=None,
        covariance=None,
    )


def pose_layers(registrar: Registrar, pose: Hypothesis, size: tuple[int, int], scale: float) -> tuple[bytes, bytes]:
    """The mesh in grey and its contours at a pose, as two transparent PNGs of the photograph as shown.

    Args:
        size: (H, W) of the photograph as shown.
        scale: of that to the photograph.
    """
    depth, K = _seen(registrar, pose, size, scale)
    seen = (depth > 0).numpy()
    grey = shade(depth[None, None], K[None])[0, 0].numpy()
    solid = np.zeros((*size, 4), np.uint8)
    solid[seen, :3] = (grey[seen, None] * np.array([255, 235, 190])).round().astype(np.uint8)
    solid[seen, 3] = 255
    lines = np.zeros((*size, 4), np.uint8)
    draw_contours(lines, depth.numpy())
    return png(solid), png(lines)


def _seen(registrar: Registrar, pose: Hypothesis, size: tuple[int, int], scale: float) -> tuple[Tensor, Tensor]:
    """(H, W) depth at a pose in the photograph as shown, and the camera matrix of that."""
    T, K = pose.projection
    half = 0.5 * scale - 0.5
    smaller = torch.tensor([[scale, 0.0, half], [0.0, scale, half], [0.0, 0.0, 1.0]], dtype=torch.float64)
    K = smaller @ K
    return registrar.describers[pose.model].renderer.render(T[None], K, size)[0, 0].cpu().float(), K


def view_pictures(registrar: Registrar, views: Tensor) -> list[bytes]:
    """A depth picture of each of (K,) views of the bank."""
    bank, out = registrar.bank, []
    for view in views.tolist():
        describe: Any = registrar.matcher.describers[int(bank.model[view])]
        depth = describe.depth(bank.rotations[view : view + 1], bank.distances[view : view + 1])[0]
        out.append(png(depth_picture(depth[0, 0].cpu())))
    return out
