"""The filters that the paper compares, by their names there."""

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn

from ...descriptors import field_points
from ...detectors import DETECTORS
from ...filters import ImageGradient, MultiScaleCurvilinearSaliency, MultiScaleFocusCurves

__all__ = ["PHOTO_FIELDS", "photo_detectors"]


PHOTO_FIELDS: dict[str, Callable[[], nn.Module]] = {
    "MFC": MultiScaleFocusCurves,
    "MCS": MultiScaleCurvilinearSaliency,
    "IG": ImageGradient,
}
"""Photographs (B, 1, H, W) to fields."""


def photo_detectors(point_fraction: float) -> dict[str, Callable[[Tensor], Tensor]]:
    """Feature points of photographs: (B, 1, H, W) to bool (B, H, W).

    The paper's three filters, thinned to points as views are, and the classical detectors of
    ``curvireg_torch.detectors``.
    """

    def of_field(make: Callable[[], nn.Module]) -> Callable[[Tensor], Tensor]:
        field = make()
        return lambda image: field_points(field(image), fraction=point_fraction)[:, 0]

    def of_detector(detect: Callable[..., Any]) -> Callable[[Tensor], Tensor]:
        return lambda image: detect(image, fraction=point_fraction).points[:, 0]

    found = {name: of_field(make) for name, make in PHOTO_FIELDS.items()}
    known = {name.lower() for name in found}
    classical = {n: of_detector(d) for n, d in DETECTORS.items() if n.lower() not in known}
    return found | classical
