"""Pictures of the page, as files in memory."""

import numpy as np
import torch
from torch import Tensor

from ..registration import Hypothesis, Registrar
from ..rendering import shade
from ..visualization.contours import contour_layer
from ..visualization.encoding import jpeg, png, shrink
from ..visualization.overlay import to_uint8, view_picture

__all__ = ["photograph_jpeg", "pose_layers", "view_pictures"]

PHOTO_SIDE = 2400  # longer side of the displayed photograph in px: it can be zoomed
LAYER_SIDE = 1400  # longer side of the layers over it


def photograph_jpeg(image: Tensor) -> bytes:
    """A JPEG of a (3, H, W) photograph with at most 2400 px on the longer side."""
    return jpeg(shrink(to_uint8(image), PHOTO_SIDE), 92)


def pose_layers(registrar: Registrar, pose: Hypothesis, size: tuple[int, int]) -> tuple[bytes, bytes]:
    """Two transparent PNGs over a photograph of ``size`` (H, W): the shaded mesh, and its contours."""
    T, K = pose.projection
    scale = min(1.0, LAYER_SIDE / max(size))
    small = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
    sy, sx = small[0] / size[0], small[1] / size[1]
    to_layer = torch.tensor([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])
    K = to_layer.double() @ K
    depth = registrar.describer.renderer.render(T[None], K, small)[0, 0].cpu().float()
    mask = (depth > 0).numpy()
    grey = shade(depth[None, None], K[None])[0, 0].numpy()
    solid = np.zeros((*small, 4), np.uint8)
    solid[mask, :3] = (grey[mask, None] * np.array([255, 235, 190])).round().astype(np.uint8)
    solid[mask, 3] = 255
    return png(solid), png(contour_layer(depth, K))


def view_pictures(registrar: Registrar, views: Tensor) -> list[bytes]:
    """A shaded picture of each of (K,) views of the bank."""
    bank = registrar.bank
    return [png(view_picture(registrar, bank.rotations[view], float(bank.distances[view]))) for view in views.tolist()]
