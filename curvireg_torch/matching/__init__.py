"""Banks of described views, and the matcher that ranks them for photographs."""

from .bank import ViewBank
from .box_shape import box_shape_score, box_shapes, whole_box_shapes
from .cache import (
    CACHE_LIMIT,
    CachedBank,
    bank_key,
    cache_folder,
    cached_bank,
    clear_cache,
    list_cache,
    trim_cache,
)
from .collection import BankCollection
from .describe import BankSettings, DescribedViews, ViewDescriber
from .index import ViewIndex
from .matcher import Ranking, ViewMatcher
from .query import QueryFeatures, slack_boxes
from .repeatability import dilate_points, repeatability, repeatability_score
from .similarity import normalized_correlation, unit_score
from .whitening import DescriptorStatistics, Whitening

__all__ = [
    "CACHE_LIMIT",
    "BankCollection",
    "BankSettings",
    "CachedBank",
    "DescribedViews",
    "DescriptorStatistics",
    "QueryFeatures",
    "Ranking",
    "ViewBank",
    "ViewDescriber",
    "ViewIndex",
    "ViewMatcher",
    "Whitening",
    "bank_key",
    "box_shape_score",
    "box_shapes",
    "cache_folder",
    "cached_bank",
    "clear_cache",
    "dilate_points",
    "list_cache",
    "normalized_correlation",
    "repeatability",
    "repeatability_score",
    "slack_boxes",
    "trim_cache",
    "unit_score",
    "whole_box_shapes",
]
