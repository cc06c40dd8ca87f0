"""Banks of described views, and the matcher that ranks them for photographs."""

from .bank import ViewBank
from .cache import bank_key, cache_folder, cached_bank
from .describe import BankSettings, DescribedViews, ViewDescriber
from .matcher import QueryFeatures, Ranking, ViewMatcher
from .repeatability import dilate_points, repeatability, repeatability_score
from .similarity import normalized_correlation, unit_score

__all__ = [
    "BankSettings",
    "DescribedViews",
    "QueryFeatures",
    "Ranking",
    "ViewBank",
    "ViewDescriber",
    "ViewMatcher",
    "bank_key",
    "cache_folder",
    "cached_bank",
    "dilate_points",
    "normalized_correlation",
    "repeatability",
    "repeatability_score",
    "unit_score",
]
