"""From a ranking of views to poses: stages as functions over photographs x hypotheses, joined by the registrar."""

from ..matching import distinct_views
from .confidence import RELIABLE, confidence, ranking_evidence
from .contour import ContourFit, fit_contours
from .finding import find
from .hypotheses import Hypotheses, hypotheses
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
    "Registrar",
    "Registration",
    "coherent_views",
    "confidence",
    "distinct_views",
    "find",
    "fit_contours",
    "hypotheses",
    "ranking_evidence",
    "search",
    "verdict",
]
