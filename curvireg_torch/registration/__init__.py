"""From a ranking of views to a pose."""

from .confidence import confidence, distinct_views
from .contour import ContourFit, fit_contours
from .pose import Registration
from .refine import RefinedPose, coherent_views, refine_pose
from .registrar import Registrar

__all__ = [
    "ContourFit",
    "RefinedPose",
    "Registrar",
    "Registration",
    "coherent_views",
    "confidence",
    "distinct_views",
    "fit_contours",
    "refine_pose",
]
