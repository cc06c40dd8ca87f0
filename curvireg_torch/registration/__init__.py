"""From a ranking of views to poses: stages as functions over photographs x hypotheses, joined by the registrar."""

from ..matching import distinct_views
from .confidence import RELIABLE, confidence, ranking_evidence
from .contour import ContourFit, fit_contours
from .hypotheses import Hypotheses, hypotheses
from .localization import Located, Locator, locate, representative_views
from .localization.objects import localize
from .registrar import Registrar
from .rescoring import rescore
from .results import FailedRegistration, Hypothesis, Localization, Registration
from .search import coherent_views, search

__all__ = [
    "RELIABLE",
    "ContourFit",
    "FailedRegistration",
    "Hypotheses",
    "Hypothesis",
    "Localization",
    "Located",
    "Locator",
    "Registrar",
    "Registration",
    "coherent_views",
    "confidence",
    "distinct_views",
    "fit_contours",
    "hypotheses",
    "localize",
    "locate",
    "ranking_evidence",
    "representative_views",
    "rescore",
    "search",
]
