"""What is to be expected of a mesh before a photograph is taken: its state, views that look alike,
and a trial."""

from .report import Inspection, inspect

__all__ = ["Inspection", "inspect"]
