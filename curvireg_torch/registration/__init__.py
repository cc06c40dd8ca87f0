"""From a ranking of views to a pose."""

from .confidence import RELIABLE, confidence, distinct_views, ranking_evidence
from .contour import ContourFit, fit_contours
from .pose import Registration
from .refine import RefinedPose, coherent_views, refine_pose
from .registrar import Registrar

__all__ = [
    "RELIABLE",
    "ContourFit",
    "RefinedPose",
    "Registrar",
    "Registration",
    "coherent_views",
    "confidence",
    "distinct_views",
    "fit_contours",
    "ranking_evidence",
    "refine_pose",
]
