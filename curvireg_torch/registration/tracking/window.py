"""The part of a frame around the object, which all measurements of the tracker share."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...errors import LostObjectError
from ...filters.inputs import fill_missing
from ...geometry.cameras import projected_boxes
from ...geometry.crops import crop_transforms, square_boxes
from ...terms import crop_regions

__all__ = ["OUTSIDE", "SIZE", "Window", "boxes_at", "cut_window"]

SIZE = 256
"""Side of a window in px."""

OUTSIDE = "at the start the mesh lies outside the photograph; check pose, unit and camera matrix"
"""Message of a :class:`LostObjectError`."""

MARGIN = 0.3
"""Added around the object's box, as a fraction of its longer side: room for motion that was not predicted."""


@dataclass(frozen=True)
class Window:
    """Pixels ``colours`` (1, 3, S, S) in [0, 1], their mean ``grey`` (S, S) uint8, and the camera ``K`` (1, 3, 3)."""

    colours: Tensor
    grey: np.ndarray
    K: Tensor


def cut_window(image: Tensor, K: Tensor, hull: Tensor, T: Tensor) -> Window:
    """The square window around an object, :data:`SIZE` px wide.

    Args:
        image: (C, H, W), C = 1 or 3, in [0, 1] or uint8; missing pixels are filled from their neighbours.
        K: (3, 3) float64 camera matrix in px.
        hull: (V, 3) float64 points of the mesh.
        T: (1, 4, 4) float64 pose.

    Raises:
        LostObjectError: the mesh lies behind the camera, or outside the image.
    """
    boxes, visible = boxes_at(hull, T, K[None], (int(image.shape[-2]), int(image.shape[-1])))
    if not bool(visible):
        raise LostObjectError(OUTSIDE)
    box = boxes.float()
    crop = crop_regions([image], box[:, None], size=SIZE, margin=MARGIN)[:, 0].float()
    colours = fill_missing(crop).expand(-1, 3, -1, -1)
    grey = (255.0 * colours[0].mean(dim=0)).round().clamp(0, 255).to(torch.uint8).numpy()
    return Window(colours, grey, crop_transforms(square_boxes(box, MARGIN), SIZE).double() @ K)


def boxes_at(hull: Tensor, T: Tensor, K: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """(N, 4) boxes in px around a mesh with ``hull`` (V, 3) at poses (N, 4, 4), in an image of ``size`` (H, W).

    And (N,) bool, False where the mesh lies behind the camera, or outside the image: there the box means nothing.
    """
    depth = (hull.to(T) @ T[:, 2, :3].mT + T[:, 2, 3]).amin(dim=0)
    boxes = projected_boxes(hull, T, K)
    limits = torch.tensor([size[1], size[0]], dtype=boxes.dtype) - 0.5
    outside = (boxes[:, :2] >= limits) | (boxes[:, 2:] <= -0.5) | (depth <= 0)[:, None]
    return boxes, ~outside.any(dim=1)
