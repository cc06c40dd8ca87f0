"""Ranking terms: scores of views for photographs, and what photographs are described by."""

from .query import QueryFeatures, box_shapes, crop_regions, jittered_boxes, photograph_field, whole_box_shapes
from .terms import (
    TERMS,
    Appearance,
    BoxShape,
    Correlation,
    Repeatability,
    RerankingModule,
    RerankingTerm,
    Term,
    Views,
    Whitening,
    ledoit_wolf,
)

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
    "box_shapes",
    "crop_regions",
    "jittered_boxes",
    "ledoit_wolf",
    "photograph_field",
    "whole_box_shapes",
]
