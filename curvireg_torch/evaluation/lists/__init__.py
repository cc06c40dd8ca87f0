"""Many photographs: lists of them, and their results in one table that grows while it is made."""

from .formats import read_list
from .listing import Entry, Listing, listing
from .photographs import is_one_photograph, list_photographs
from .records import RESULT_COLUMNS, Records
from .run import Counts, register_entry, register_list

__all__ = [
    "RESULT_COLUMNS",
    "Counts",
    "Entry",
    "Listing",
    "Records",
    "is_one_photograph",
    "list_photographs",
    "listing",
    "read_list",
    "register_entry",
    "register_list",
]
