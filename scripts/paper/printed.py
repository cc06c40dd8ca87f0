"""The numbers that the paper prints, to stand beside ours.

printed.json holds its tables: of each class of PASCAL3D+, and of ten objects of its web collection,
the numbers of all ``DETECTORS``, IP in percent; of each class the precision of all ``PAIRS``; of
each pair errors of elevation, azimuth, yaw and distance, estimated and closest. The paper's plane
and table have their names in PASCAL3D+.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from scripts._shared import read_json

PAIRS = tuple(f"{depth}/{photo}" for depth in ("CS", "ASG", "AR") for photo in ("MFC", "MCS", "IG"))
TABLES = read_json(Path(__file__).with_suffix(".json"))
DETECTORS = TABLES["detectors"]


def _means(rows: Sequence[Sequence[float]], names: Sequence[str], unit: float) -> dict[str, float]:
    """Of each column."""
    return dict(zip(names, unit * np.mean(rows, axis=0), strict=True))


IP = _means(list(TABLES["ip"].values()), DETECTORS, 0.01)
WEB_IP = _means(TABLES["web_ip"], DETECTORS, 0.01)
HAUSDORFF = _means(list(TABLES["hausdorff"].values()), DETECTORS, 1.0)
WEB_HAUSDORFF = _means(TABLES["web_hausdorff"], DETECTORS, 1.0)
PRECISION = _means(list(TABLES["precision"].values()), PAIRS, 1.0)
"""Means over the classes that the paper prints; of the web collection, over its objects."""

IP_BY_CLASS = {name: _means([row], DETECTORS, 0.01) for name, row in TABLES["ip"].items()}
PRECISION_BY_CLASS = {name: _means([row], PAIRS, 1.0) for name, row in TABLES["precision"].items()}
"""What the paper prints for each class."""


POSE_ERRORS = TABLES["pose_errors"]
