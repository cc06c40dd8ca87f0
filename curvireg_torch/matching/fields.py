"""Depth filters and descriptors of a bank, built from its settings."""

from torch import nn

from ..descriptors import HOG
from ..filters import ApparentRidges, AverageShadingGradient, DepthCurvilinearSaliency, HessianFrobeniusNorm
from ..settings import BankSettings

__all__ = ["depth_filter", "hog_layer"]

_OTHERS: dict[str, type[nn.Module]] = {"ASG": AverageShadingGradient, "HFN": HessianFrobeniusNorm, "AR": ApparentRidges}


def depth_filter(settings: BankSettings) -> nn.Module:
    """The filter that turns rendered depth into vector fields.

    Example:
        >>> depth_filter(BankSettings(depth_field="HFN"))
        HessianFrobeniusNorm(sigma=1.0, depth_scale=None)
    """
    if settings.depth_field == "CS":
        return DepthCurvilinearSaliency(sigma=settings.sigma, formula=settings.formula)
    return _OTHERS[settings.depth_field]()


def hog_layer(settings: BankSettings) -> HOG:
    """The descriptor of views and photographs.

    Example:
        >>> hog_layer(BankSettings()).length
        1764
    """
    return HOG(grid=settings.grid, bins=settings.bins, block=settings.block, clip=settings.clip)
