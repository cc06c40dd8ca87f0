"""Banks of described views, and the matcher that ranks them for photographs."""

from .bank import ViewBank
from .cache import CachedBank, bank_key, cache_folder, cached_bank, clear_cache, list_cache
from .describe import DescribedViews, ViewDescriber
from .matcher import Ranking, ViewMatcher, distinct_views

__all__ = [
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
]
