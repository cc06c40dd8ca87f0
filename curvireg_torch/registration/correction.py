"""Correction of inexact boxes: a box that does not fit the pose is replaced by the projected mesh's box."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ..errors import CurviregError
from ..geometry.cameras import projected_boxes
from ..geometry.crops import box_iou
from .estimator import PoseEstimator
from .inputs import ImageItem
from .results import FailedRegistration, Registration

__all__ = ["corrected", "projected_box"]

AGREE = 0.85
"""Overlap (IoU) from which two boxes count as the same: boxes drawn by hand had at least 0.86 with the box of the pose
on 60 generated photographs, see docs/experiments.md."""

Results = Sequence[Registration | FailedRegistration]


def corrected(
    estimator: PoseEstimator, items: Sequence[ImageItem | CurviregError], results: Results
) -> list[Registration | FailedRegistration]:
    """Register again with the box of the pose where it differs from the given box, and keep the higher ``score``.

    Results without a camera matrix are returned unchanged, as those poses are derived from their boxes.
    """
    changed: dict[int, ImageItem] = {}
    for k, (item, result) in enumerate(zip(items, results, strict=True)):
        if isinstance(item, ImageItem) and isinstance(result, Registration) and item.camera_matrix is not None:
            box = projected_box(estimator, result)
            if _differs(box, item):
                changed[k] = replace(item, box=box.float())
    better = list(results)
    for (k, item), result in zip(changed.items(), estimator.register_items([*changed.values()]), strict=True):
        if isinstance(result, Registration) and result.score > results[k].score:
            better[k] = replace(result, corrected_box=item.box.double())
    return better


def _differs(box: Tensor, item: ImageItem) -> bool:
    """Whether a box is partly inside the photograph and shows another part of it than the item's box."""
    H, W = item.image.shape[-2:]
    pair = torch.stack([box, item.box.to(box)]).clamp(min=-0.5)
    pair = torch.minimum(pair, torch.tensor([W, H, W, H]).to(pair) - 0.5)
    inside = bool((pair[0, 2:] > pair[0, :2]).all()) and bool(box.isfinite().all())
    return inside and float(box_iou(pair[:1], pair[1:])) < AGREE


def projected_box(estimator: PoseEstimator, result: Registration) -> Tensor:
    """(4,) float64 box around the projected mesh, px of the photograph."""
    T, K = result.projection
    return projected_boxes(estimator.describers[result.model].hull, T[None], K)[0]
