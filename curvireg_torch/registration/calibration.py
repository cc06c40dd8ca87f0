"""Constants that scripts/calibrate.py found on registered photographs of the benchmark."""

import json
from pathlib import Path
from typing import Any

from torch import Tensor

__all__ = ["CALIBRATION", "SQUARED_RADIUS", "covariance_scale"]

CALIBRATION: dict[str, Any] = json.loads(Path(__file__).with_name("calibration.json").read_text(encoding="utf-8"))

SQUARED_RADIUS: dict[float, float] = {float(k): v for k, v in CALIBRATION["covariance"]["squared_radius"].items()}
"""By probability, 0.5, 0.9 and 0.95: so often the true pose lies in the ellipsoid e^T C^-1 e <= squared radius, C being
the covariance of a reliable answer. That of 0.95 is a Gaussian's; errors have heavier tails, so the others are not."""


def covariance_scale(matched: Tensor, constants: dict[str, float] = CALIBRATION["covariance"]) -> Tensor:
    """By what to multiply the covariance of the least squares, which knows nothing of wrong edges.

    Args:
        matched: (N,) share of the contour points that lie by an edge: the fewer, the more of these edges are others.
        constants: factor and power.
    """
    return constants["factor"] * (1.02 - matched) ** constants["power"]
