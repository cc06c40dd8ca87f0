"""From a ranking of views to a pose."""

from .confidence import RELIABLE, confidence, distinct_views, ranking_evidence
from .pose import Registration
from .refine import RefinedPose, coherent_views, refine_pose
from .registrar import Registrar

__all__ = [
    "RELIABLE",
    "RefinedPose",
    "Registrar",
    "Registration",
    "coherent_views",
    "confidence",
    "distinct_views",
    "ranking_evidence",
    "refine_pose",
]
