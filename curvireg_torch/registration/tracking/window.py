"""The part of a frame around the object, which all terms of the tracker share."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...filters.inputs import fill_missing
from ...geometry.crops import crop_transforms, square_boxes
from ...terms import crop_regions

__all__ = ["MARGIN", "SIZE", "Window", "cut_window"]

SIZE = 256
"""Side of a window in px."""

MARGIN = 0.3
"""Added around the object's box, as a fraction of its longer side: motion that the prediction did not foresee."""


@dataclass(frozen=True)
class Window:
    """Pixels ``colours`` (1, 3, S, S) in [0, 1], the same in ``grey`` (S, S) uint8, and the camera ``K`` (1, 3, 3)."""

    colours: Tensor
    grey: np.ndarray
    K: Tensor


def cut_window(image: Tensor, box: Tensor, K: Tensor) -> Window:
    """The square window around a ``box`` (4,) px of a photograph (C, H, W) with camera matrix ``K`` (3, 3)."""
    box = box[None].float()
    crop = crop_regions([image], box[:, None], size=SIZE, margin=MARGIN)[:, 0].float()
    colours = fill_missing(crop).expand(-1, 3, -1, -1)
    grey = (colours[0].mean(dim=0) * 255.0).round().clamp(0, 255).to(torch.uint8).numpy()
    return Window(colours, grey, crop_transforms(square_boxes(box, MARGIN), SIZE).double() @ K)
