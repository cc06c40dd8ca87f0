"""From a ranking of views to a pose."""

from .confidence import confidence, distinct_views
from .pose import Registration
from .refine import RefinedPose, coherent_views, refine_pose
from .registrar import Registrar

__all__ = [
    "RefinedPose",
    "Registrar",
    "Registration",
    "coherent_views",
    "confidence",
    "distinct_views",
    "refine_pose",
]
