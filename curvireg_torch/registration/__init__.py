"""From a ranking of views to poses: stages as functions over photographs x hypotheses, joined by the registrar."""

from ..matching import distinct_views
from .confidence import RELIABLE, confidence, ranking_evidence
from .contour import ContourFit, fit_contours
from .hypotheses import Hypotheses, hypotheses
from .localization import Located, Locator, locate, representative_views
from .localization.localize import find
from .pose import FailedRegistration, Found, Hypothesis, Registration
from .registrar import Registrar
from .search import coherent_views, search
from .verify import verdict

__all__ = [
    "RELIABLE",
    "ContourFit",
    "FailedRegistration",
    "Found",
    "Hypotheses",
    "Hypothesis",
    "Located",
    "Locator",
    "Registrar",
    "Registration",
    "coherent_views",
    "confidence",
    "distinct_views",
    "find",
    "fit_contours",
    "hypotheses",
    "locate",
    "ranking_evidence",
    "representative_views",
    "search",
    "verdict",
]
