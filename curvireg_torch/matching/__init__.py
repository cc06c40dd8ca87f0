"""Banks of described views, and the matcher that ranks them for photographs."""

from .bank import ViewBank
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
from .matcher import QueryFeatures, Ranking, ViewMatcher
from .near_symmetry import NearSymmetry, near_symmetries
from .repeatability import dilate_points, repeatability, repeatability_score
from .similarity import normalized_correlation, unit_score

__all__ = [
    "CACHE_LIMIT",
    "BankCollection",
    "BankSettings",
    "CachedBank",
    "DescribedViews",
    "NearSymmetry",
    "QueryFeatures",
    "Ranking",
    "ViewBank",
    "ViewDescriber",
    "ViewMatcher",
    "bank_key",
    "cache_folder",
    "cached_bank",
    "clear_cache",
    "dilate_points",
    "list_cache",
    "near_symmetries",
    "normalized_correlation",
    "repeatability",
    "repeatability_score",
    "trim_cache",
    "unit_score",
]
