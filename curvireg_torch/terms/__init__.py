"""Ranking terms: scores of views for photographs, and what photographs are described by."""

from .query import QueryFeatures, crop_regions, jittered_boxes, photograph_field
from .scores import (
    Whitening,
    box_shape_score,
    box_shapes,
    dilate_points,
    ledoit_wolf,
    normalized_correlation,
    repeatability,
    repeatability_score,
    unit_score,
    whole_box_shapes,
)
from .terms import TERMS, Appearance, BoxShape, Correlation, Repeatability, RerankingModule, RerankingTerm, Term, Views

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
