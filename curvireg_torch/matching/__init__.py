"""Banks of described views, and the matcher that ranks them for photographs."""

from ..settings import BankSettings
from ..terms import (
    DescriptorStatistics,
    QueryFeatures,
    Whitening,
    box_shape_score,
    box_shapes,
    dilate_points,
    jittered_boxes,
    normalized_correlation,
    repeatability,
    repeatability_score,
    unit_score,
    whole_box_shapes,
)
from .bank import ViewBank
from .cache import CACHE_LIMIT, CachedBank, bank_key, cache_folder, cached_bank, clear_cache, list_cache, trim_cache
from .describe import DescribedViews, ViewDescriber
from .distinct import distinct_views
from .matcher import Ranking, ViewMatcher

__all__ = [
    "CACHE_LIMIT",
    "BankSettings",
    "CachedBank",
    "DescribedViews",
    "DescriptorStatistics",
    "QueryFeatures",
    "Ranking",
    "ViewBank",
    "ViewDescriber",
    "ViewMatcher",
    "Whitening",
    "bank_key",
    "box_shape_score",
    "box_shapes",
    "cache_folder",
    "cached_bank",
    "clear_cache",
    "dilate_points",
    "distinct_views",
    "jittered_boxes",
    "list_cache",
    "normalized_correlation",
    "repeatability",
    "repeatability_score",
    "trim_cache",
    "unit_score",
    "whole_box_shapes",
]
