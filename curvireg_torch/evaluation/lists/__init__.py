"""Lists of photographs, and the tables of their results."""

from .entries import Entry, PhotoList
from .formats import read_list
from .photographs import list_photographs
from .register import Counts, check_entry, register_entry, register_list

__all__ = [
    "Counts",
    "Entry",
    "PhotoList",
    "check_entry",
    "list_photographs",
    "read_list",
    "register_entry",
    "register_list",
]
