"""Boxes that are only roughly right: the box around the pose that one led to takes its place."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..errors import CurviregError
from ..geometry.cameras import projected_boxes
from ..geometry.crops import box_iou
from .inputs import ImageItem
from .results import FailedRegistration, Registration

if TYPE_CHECKING:
    from .registrar import Registrar

__all__ = ["AGREE", "corrected", "projected_box"]

AGREE = 0.85
"""Overlap (IoU) from which a box and the one around its pose are taken for the same: boxes drawn by hand had 0.86 or
more on 60 generated photographs, see docs/experiments.md."""

Results = Sequence[Registration | FailedRegistration]


def corrected(registrar: "Registrar", items: Sequence[ImageItem | CurviregError], results: Results) -> Results:
    """The better of each answer and of what the box around its pose leads to, where that is another than its own.

    The better is the one whose view is more like the photograph. Without a camera matrix poses keep to their boxes, and
    answers stay as they are.

    Args:
        registrar: that made the results.
        items: B photographs with their boxes.
        results: of the same.
    """
    moved: dict[int, ImageItem] = {}
    for k, (item, result) in enumerate(zip(items, results, strict=True)):
        if isinstance(item, ImageItem) and isinstance(result, Registration) and item.camera_matrix is not None:
            box = projected_box(registrar, result)
            if _is_another(box, item):
                moved[k] = replace(item, box=box.float())
    better = list(results)
    for (k, item), result in zip(moved.items(), registrar.register_items([*moved.values()]), strict=True):
        if isinstance(result, Registration) and result.score > results[k].score:
            better[k] = replace(result, corrected_box=item.box.double())
    return better


def _is_another(box: Tensor, item: ImageItem) -> bool:
    """Whether a box shows another part of a photograph than the box given with it, and some of it."""
    H, W = item.image.shape[-2:]
    pair = torch.stack([box, item.box.to(box)]).clamp(min=-0.5)
    pair = torch.minimum(pair, torch.tensor([W, H, W, H]).to(pair) - 0.5)
    inside = bool((pair[0, 2:] > pair[0, :2]).all()) and bool(box.isfinite().all())
    return inside and float(box_iou(pair[:1], pair[1:])) < AGREE


def projected_box(registrar: "Registrar", result: Registration) -> Tensor:
    """(4,) float64 box around the pose that was found, px of the photograph."""
    T, K = result.projection
    return projected_boxes(registrar.describers[result.model].hull, T[None], K)[0]
