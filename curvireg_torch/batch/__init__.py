"""Many photographs: lists of them, and their results in one table that grows while it is made."""

from .listing import Entry, Listing, read_list
from .records import RESULT_COLUMNS, Records
from .run import Counts, register_entry, register_list

__all__ = ["RESULT_COLUMNS", "Counts", "Entry", "Listing", "Records", "read_list", "register_entry", "register_list"]
