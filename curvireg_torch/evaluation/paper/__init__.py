"""The measurements of the paper, on any of the datasets; ``scripts/paper/reproduce_paper.py`` runs them."""

from .cases import Case, find_cases
from .points import curve_table, detector_tables, repeatability_table
from .rankings import angle_table, precision_table, rank_tables, rank_views
from .tables import Table, write_table

__all__ = [
    "Case",
    "Table",
    "angle_table",
    "curve_table",
    "detector_tables",
    "find_cases",
    "precision_table",
    "rank_tables",
    "rank_views",
    "repeatability_table",
    "write_table",
]
