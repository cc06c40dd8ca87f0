"""Depth filters and descriptors of a bank, built from its settings."""

from torch import nn

from ..features import HOG
from ..settings import DEPTH_FIELDS, BankSettings

__all__ = ["depth_filter", "hog_layer"]


def depth_filter(settings: BankSettings) -> nn.Module:
    """The filter that turns rendered depth into vector fields.

    Example:
        >>> type(depth_filter(BankSettings(depth_field="HFN"))).__name__
        'HessianFrobeniusNorm'
    """
    options = {"sigma": settings.sigma, "formula": settings.formula} if settings.depth_field == "CS" else {}
    layer: nn.Module = DEPTH_FIELDS[settings.depth_field](**options)
    return layer


def hog_layer(settings: BankSettings) -> HOG:
    """The descriptor of views and photographs.

    Example:
        >>> hog_layer(BankSettings()).length
        1764
    """
    return HOG(grid=settings.grid, bins=settings.bins, block=settings.block, clip=settings.clip)
