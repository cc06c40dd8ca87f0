"""Constants that scripts/calibration/calibrate.py found on registered photographs of the benchmark."""

import json
from pathlib import Path
from typing import Any

__all__ = ["CALIBRATION", "COVARIANCE_SCALE", "SQUARED_RADIUS"]

CALIBRATION: dict[str, Any] = json.loads(Path(__file__).with_name("calibration.json").read_text(encoding="utf-8"))

COVARIANCE_SCALE: float = CALIBRATION["covariance"]["scale"]
"""By what the covariance of the least squares is multiplied: they know nothing of edges that are not the object's."""

SQUARED_RADIUS: dict[float, float] = {float(k): v for k, v in CALIBRATION["covariance"]["squared_radius"].items()}
"""By probability, 0.5, 0.9 and 0.95: so often the true pose lies in the ellipsoid e^T C^-1 e <= squared radius, C being
the covariance of a reliable answer. That of 0.95 is a Gaussian's; errors have heavier tails, so the others are not."""
