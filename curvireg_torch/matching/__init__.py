"""Banks of described views, and the matcher that ranks them for photographs."""

from ..utils.files import cache_folder as cache_folder
from .bank import ViewBank as ViewBank
from .cache import CachedBank as CachedBank
from .cache import bank_key as bank_key
from .cache import cached_bank as cached_bank
from .cache import clear_cache as clear_cache
from .cache import list_cache as list_cache
from .cells import distinct_views as distinct_views
from .describe import ViewDescriber as ViewDescriber
from .matcher import Ranking as Ranking
from .matcher import ViewMatcher as ViewMatcher
