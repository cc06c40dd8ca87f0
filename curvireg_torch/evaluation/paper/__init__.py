"""The measurements of the paper, on any of the datasets; ``scripts/paper/reproduce_paper.py`` runs them."""

from .cases import DATASETS, Case, find_cases
from .fields import PHOTO_FIELDS, photo_detectors
from .points import curve_table, detector_tables, repeatability_table
from .rankings import Rankings, angle_table, precision_table, rank_tables, rank_views
from .tables import Table, write_table

__all__ = [
    "DATASETS",
    "PHOTO_FIELDS",
    "Case",
    "Rankings",
    "Table",
    "angle_table",
    "curve_table",
    "detector_tables",
    "find_cases",
    "photo_detectors",
    "precision_table",
    "rank_tables",
    "rank_views",
    "repeatability_table",
    "write_table",
]
