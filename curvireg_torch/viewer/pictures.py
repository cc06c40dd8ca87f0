"""Pictures of the page, as files in memory."""

import numpy as np
import torch
from torch import Tensor

from ..registration import Hypothesis, Registrar
from ..rendering.shading import shade
from ..visualization.contours import contour_layer
from ..visualization.encoding import jpeg, png, shrink
from ..visualization.overlay import to_uint8, view_picture

__all__ = ["photograph_jpeg", "pose_layers", "view_pictures"]

SIDE = 1400  # longer side of the displayed photograph in px


def photograph_jpeg(image: Tensor) -> tuple[bytes, float]:
    """A JPEG of a (3, H, W) photograph with at most 1400 px on the longer side, and its scale to the photograph."""
    pixels = shrink(to_uint8(image), SIDE)
    return jpeg(pixels, 92), pixels.shape[1] / image.shape[-1]


def pose_layers(registrar: Registrar, pose: Hypothesis, size: tuple[int, int], scale: float) -> tuple[bytes, bytes]:
    """Two transparent PNGs of ``size`` (H, W), that of the displayed photograph: the shaded mesh, and its contours.

    ``scale`` is that of the displayed photograph to the photograph.
    """
    T, K = pose.projection
    half = 0.5 * scale - 0.5
    K = torch.tensor([[scale, 0.0, half], [0.0, scale, half], [0.0, 0.0, 1.0]], dtype=torch.float64) @ K
    depth = registrar.describers[pose.model].renderer.render(T[None], K, size)[0, 0].cpu().float()
    mask = (depth > 0).numpy()
    grey = shade(depth[None, None], K[None])[0, 0].numpy()
    solid = np.zeros((*size, 4), np.uint8)
    solid[mask, :3] = (grey[mask, None] * np.array([255, 235, 190])).round().astype(np.uint8)
    solid[mask, 3] = 255
    return png(solid), png(contour_layer(depth, K))


def view_pictures(registrar: Registrar, views: Tensor) -> list[bytes]:
    """A shaded picture of each of (K,) views of the bank."""
    bank = registrar.bank
    return [
        png(view_picture(registrar, int(bank.model[view]), bank.rotations[view], float(bank.distances[view])))
        for view in views.tolist()
    ]
