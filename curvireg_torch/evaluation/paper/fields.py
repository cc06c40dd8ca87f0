"""The filters that the paper compares, by the names it gives them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from ... import filters
from ...descriptors import field_points
from ...matching import BankSettings

__all__ = ["DEPTH_FIELDS", "PHOTO_FIELDS", "FieldSettings", "photo_detectors"]


def _available(names: Mapping[str, str]) -> dict[str, Callable[[], nn.Module]]:
    return {short: getattr(filters, name) for short, name in names.items() if hasattr(filters, name)}


DEPTH_FIELDS = _available(
    {
        "CS": "DepthCurvilinearSaliency",
        "ASG": "AverageShadingGradient",
        "HFN": "HessianFrobeniusNorm",
        "AR": "ApparentRidges",
    }
)
"""Depth images (B, 1, H, W) to fields."""

PHOTO_FIELDS = _available(
    {"MFC": "MultiScaleFocusCurves", "MCS": "MultiScaleCurvilinearSaliency", "IG": "ImageGradient"}
)
"""Photographs (B, 1, H, W) to fields."""


@dataclass(frozen=True)
class FieldSettings(BankSettings):
    """Settings of a bank whose views go through any filter of :data:`DEPTH_FIELDS`."""

    depth_field: str = "CS"

    def depth_filter(self) -> Any:
        return super().depth_filter() if self.depth_field == "CS" else DEPTH_FIELDS[self.depth_field]()


def photo_detectors(point_share: float) -> dict[str, Callable[[Tensor], Tensor]]:
    """Feature points of photographs: (B, 1, H, W) to bool (B, H, W).

    The paper's three filters, thinned to points as views are, and the classical detectors of
    ``curvireg_torch.detectors``.
    """

    def of_field(make: Callable[[], nn.Module]) -> Callable[[Tensor], Tensor]:
        field = make()
        return lambda image: field_points(field(image), share=point_share)[:, 0]

    def of_detector(detect: Callable[..., Any]) -> Callable[[Tensor], Tensor]:
        return lambda image: detect(image, share=point_share).points[:, 0]

    found = {name: of_field(make) for name, make in PHOTO_FIELDS.items()}
    known = {name.lower() for name in found}
    classical = {n: of_detector(d) for n, d in _classical().items() if n.lower() not in known}
    return found | classical


def _classical() -> dict[str, Any]:
    try:
        from ...detectors import DETECTORS  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        return {}
    return dict(DETECTORS)
