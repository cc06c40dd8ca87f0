"""Fields by the names that pipelines use: filters of photographs and of depth images.

A new field is a module here, or in a file of its own, and its name in a dictionary.
"""

from collections.abc import Callable
from functools import partial

from torch import nn

from ..filters import (
    ApparentRidges,
    AverageShadingGradient,
    DepthCurvilinearSaliency,
    HessianFrobeniusNorm,
    ImageGradient,
    MultiScaleCurvilinearSaliency,
    MultiScaleFocusCurves,
)
from ..filters.focus import PAPER_THRESHOLD
from .learned_field import LearnedCurvilinearSaliency

FIELDS: dict[str, Callable[[], nn.Module]] = {
    "learned": LearnedCurvilinearSaliency,
    "focus": MultiScaleFocusCurves,
    "MFC": partial(
        MultiScaleFocusCurves,
        mode="reblur-saliency",
        saliency_weight=0.0,
        threshold=PAPER_THRESHOLD,
    ),
    "saliency": MultiScaleCurvilinearSaliency,
    "gradient": ImageGradient,
}
"""Photograph filters by name: modules that are built without arguments. "MFC" is the paper's,
"focus" the same weighted by CS, with the exact formula of the blur."""

DEPTH_FIELDS: dict[str, Callable[..., nn.Module]] = {
    "CS": DepthCurvilinearSaliency,
    "ASG": AverageShadingGradient,
    "HFN": HessianFrobeniusNorm,
    "AR": ApparentRidges,
}
"""Depth filters by the paper's names: modules (N, 1, S, S) -> (N, 2, S, S) that are built without
arguments."""
