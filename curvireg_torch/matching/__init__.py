"""Banks of described views, and the matcher that ranks them for photographs."""

from .bank import ViewBank
from .cache import CACHE_LIMIT, CachedBank, bank_key, cache_folder, cached_bank, clear_cache, list_cache, trim_cache
from .describe import DescribedViews, ViewDescriber
from .matcher import ViewMatcher
from .ranking import Ranking, distinct_views

__all__ = [
    "CACHE_LIMIT",
    "CachedBank",
    "DescribedViews",
    "Ranking",
    "ViewBank",
    "ViewDescriber",
    "ViewMatcher",
    "bank_key",
    "cache_folder",
    "cached_bank",
    "clear_cache",
    "distinct_views",
    "list_cache",
    "trim_cache",
]
