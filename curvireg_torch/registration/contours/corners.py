"""Corners of a picture on the surface of a mesh whose pose is known."""

import cv2
import numpy as np
import torch
from torch import Tensor

__all__ = ["surface_corners"]


def surface_corners(
    grey: np.ndarray, depth: Tensor, T: Tensor, K: Tensor, *, count: int, apart: int, quality: float, inside: int
) -> tuple[np.ndarray, Tensor]:
    """Corners inside the object's outline, and the points of the surface that they show.

    Args:
        grey: (S, S) uint8.
        depth: (1, 1, S, S) of the mesh at the pose.
        T, K: (1, 4, 4) pose and (1, 3, 3) camera.
        count, apart: corners at most, and px apart at least.
        quality: least strength as a fraction of the strongest corner's.
        inside: least distance from the outline in px.

    Returns:
        uv (C, 2) px, whole numbers in float32, and points of the model (1, C, 3).
    """
    side = 2 * inside + 1
    mask = cv2.erode((depth[0, 0] > 0).to(torch.uint8).numpy(), np.ones((side, side), np.uint8), borderValue=0)
    found = cv2.goodFeaturesToTrack(grey, count, quality, apart, mask=mask)
    uv = np.zeros((0, 2), np.float32) if found is None else found[:, 0]
    pixel = torch.from_numpy(uv).double()
    column, row = pixel.round().long().unbind(-1)
    rays = torch.cat([pixel, torch.ones_like(pixel[:, :1])], dim=1) @ torch.linalg.inv(K[0]).mT
    z = depth[0, 0, row, column].double()
    return uv, ((rays * z[:, None] - T[0, :3, 3]) @ T[0, :3, :3])[None]
