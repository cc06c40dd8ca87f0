"""The numbers that the paper prints, to stand beside ours.

printed.json holds its tables: of each class of PASCAL3D+, and of ten objects of its web collection,
the numbers of all ``DETECTORS``, IP in percent; of each class the precision of all ``PAIRS``; of
each pair errors of elevation, azimuth, yaw and distance, estimated and closest. The paper's plane
and table have their names in PASCAL3D+.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import fmean

from scripts._shared import read_json

PAIRS = tuple(f"{depth}/{photo}" for depth in ("CS", "ASG", "AR") for photo in ("MFC", "MCS", "IG"))
TABLES = read_json(Path(__file__).with_suffix(".json"))
DETECTORS = TABLES["detectors"]


def _named(row: Sequence[float], names: Sequence[str], unit: float = 1.0) -> dict[str, float]:
    return {name: unit * value for name, value in zip(names, row, strict=True)}


def _means(
    rows: Iterable[Sequence[float]], names: Sequence[str], unit: float = 1.0
) -> dict[str, float]:
    """Of each column."""
    columns = zip(*rows, strict=True)
    return _named([fmean(column) for column in columns], names, unit)


IP = _means(TABLES["ip"].values(), DETECTORS, 0.01)
WEB_IP = _means(TABLES["web_ip"], DETECTORS, 0.01)
HAUSDORFF = _means(TABLES["hausdorff"].values(), DETECTORS)
WEB_HAUSDORFF = _means(TABLES["web_hausdorff"], DETECTORS)
PRECISION = _means(TABLES["precision"].values(), PAIRS)
"""Means over the classes that the paper prints; of the web collection, over its objects."""

IP_BY_CLASS = {name: _named(row, DETECTORS, 0.01) for name, row in TABLES["ip"].items()}
PRECISION_BY_CLASS = {name: _named(row, PAIRS) for name, row in TABLES["precision"].items()}
"""What the paper prints for each class."""

POSE_ERRORS = TABLES["pose_errors"]
