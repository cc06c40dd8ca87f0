"""Where in a photograph might the object be? Boxes for the stages behind."""

from .locator import Located, Locator, locate
from .representatives import representative_views

__all__ = ["Located", "Locator", "locate", "representative_views"]
