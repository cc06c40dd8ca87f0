"""Ranking terms: each compares photographs with views, one file each; the ranking multiplies them."""

from ..utils.registry import Registry
from .appearance import Appearance
from .base import RerankingModule, RerankingTerm, Term, Views
from .box_shape import BoxShape, box_shape_score, box_shapes, whole_box_shapes
from .correlation import Correlation, normalized_correlation, unit_score
from .query import QueryFeatures, crop_regions, jittered_boxes, photograph_field
from .repeatability import Repeatability, dilate_points, repeatability, repeatability_score
from .whitening import Whitening, ledoit_wolf

__all__ = [
    "TERMS",
    "Appearance",
    "BoxShape",
    "Correlation",
    "QueryFeatures",
    "Repeatability",
    "RerankingModule",
    "RerankingTerm",
    "Term",
    "Views",
    "Whitening",
    "box_shape_score",
    "box_shapes",
    "crop_regions",
    "dilate_points",
    "jittered_boxes",
    "ledoit_wolf",
    "normalized_correlation",
    "photograph_field",
    "repeatability",
    "repeatability_score",
    "unit_score",
    "whole_box_shapes",
]

TERMS: Registry[type[Term]] = Registry("term", {t.name: t for t in (Correlation, Repeatability, BoxShape, Appearance)})
"""Terms by the name that JSON files of pipelines use."""
