"""Constants that scripts/calibration fitted on generated photographs."""

import json
from pathlib import Path
from typing import Any

__all__ = ["CALIBRATION", "COVARIANCE_SCALE"]

# For each model its ``weights`` and ``bias``; for "instance" and "category" also ``slope`` and
# ``resolution``, see
# :func:`curvireg_torch.registration.confidence.shares`
CALIBRATION: dict[str, Any] = json.loads(
    (Path(__file__).parent / "calibration.json").read_text(encoding="utf-8")
)
# Factor of the least-squares covariance, which ignores edges that do not belong to the object: with
# it, nine in ten true poses lay in the 90 % ellipsoid of a reliable result, on an earlier set of
# generated photographs (docs/method.md)
COVARIANCE_SCALE: float = CALIBRATION["covariance_scale"]
