"""Banks of described views, and the matcher that ranks them for photographs."""

from ..utils.files import cache_folder
from .bank import ViewBank
from .cache import CachedBank, bank_key, cached_bank, clear_cache, list_cache
from .cells import distinct_views
from .describe import ViewDescriber
from .matcher import Ranking, ViewMatcher

__all__ = [
    "CachedBank",
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
