"""Locator: boxes where the object may be in a photograph that comes without one."""

from .locator import Located, Locator, locate
from .representatives import representative_views

__all__ = ["Located", "Locator", "locate", "representative_views"]
