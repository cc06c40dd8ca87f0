"""Constants that scripts/calibration fitted on photographs of the benchmark: calibrate.py, refinement.py and
tracking.py."""

import json
from pathlib import Path
from typing import Any

__all__ = ["CALIBRATION", "COVARIANCE_SCALE", "REFINEMENT", "SQUARED_RADIUS", "TRACKING"]

CALIBRATION: dict[str, Any] = json.loads(Path(__file__).with_name("calibration.json").read_text(encoding="utf-8"))

REFINEMENT: dict[str, Any] = json.loads(Path(__file__).with_name("refinement.json").read_text(encoding="utf-8"))
"""Weights and bias of :func:`curvireg_torch.registration.confidence.refinement_confidence`."""

TRACKING: dict[str, Any] = json.loads(Path(__file__).with_name("tracking.json").read_text(encoding="utf-8"))
"""Weights and bias of :func:`curvireg_torch.registration.confidence.tracking_confidence`."""

COVARIANCE_SCALE: float = CALIBRATION["covariance"]["scale"]
"""Factor of the least-squares covariance, which ignores edges that do not belong to the object."""

SQUARED_RADIUS: dict[float, float] = {float(k): v for k, v in CALIBRATION["covariance"]["squared_radius"].items()}
"""For the probabilities 0.5, 0.9 and 0.95: the true pose lies in the ellipsoid e^T C^-1 e <= squared radius that often,
C being the covariance of a reliable result. The value of 0.9 is a Gaussian's; as errors have heavier tails, the others
are not."""
