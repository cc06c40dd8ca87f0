"""Contour fits on the device of the contours, from tables on the CPU."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..rendering.contours import MeshContours
from ..utils.rows import Rows
from .edges import EdgeCrops

__all__ = ["on_device"]

Measured = TypeVar("Measured")


def on_device(
    function: Callable[..., Measured],
    contours: MeshContours,
    crops: EdgeCrops,
    *tensors: Tensor,
    **options: Any,
) -> Measured:
    """``function(contours, crops, *tensors, **options)`` on the device of the contours: a tensor, a
    tuple of these, or :class:`.Rows`; the result is on the CPU."""
    device = contours.device
    moved = [_moved(x, device) for x in tensors]
    of_device = {name: _moved(value, device) for name, value in options.items()}
    # on a CPU many small steps take a tenth less time in it
    with torch.inference_mode(device.type == "cpu"):
        measured = function(contours, crops.to(device), *moved, **of_device)
    result: Measured = _ordinary(measured)
    return result


def _moved(value: Any, device: torch.device) -> Any:
    return value.to(device) if isinstance(value, Tensor) else value


def _ordinary(measured: Any) -> Any:
    """Tensors on the CPU like any other, which may be changed and saved."""
    if isinstance(measured, Tensor):
        return measured.cpu().clone()
    if isinstance(measured, Rows):
        columns = {name: _ordinary(column) for name, column in measured.columns().items()}
        return replace(measured, **columns)
    return tuple(_ordinary(one) for one in measured)
