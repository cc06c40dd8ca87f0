"""From a ranking of views to poses: stages as functions over photographs x hypotheses, joined by the registrar."""

from ..matching import distinct_views
from .answer_set import AnswerSet
from .confidence import RELIABLE, confidence, ranking_evidence
from .contour_fit import ContourFit, fit_contours
from .following import Follower
from .hypotheses import Hypotheses, start_hypotheses
from .localization import localize
from .locator import Located, Locator, locate, representative_views
from .refinement import refine
from .registrar import Registrar
from .rescoring import rescore
from .results import FailedRegistration, Hypothesis, Localization, Registration
from .search import coherent_views, search

__all__ = [
    "RELIABLE",
    "AnswerSet",
    "ContourFit",
    "FailedRegistration",
    "Follower",
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
    "localize",
    "locate",
    "ranking_evidence",
    "refine",
    "representative_views",
    "rescore",
    "search",
    "start_hypotheses",
]
