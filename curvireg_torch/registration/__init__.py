"""From a ranking of views to poses: registration, refinement, following, and detection without a box."""

from .confidence import RELIABLE
from .contour_fit import ContourFit, fit_contours
from .detection import Detector, Proposals, detect
from .following import Follower
from .refinement import refine
from .registrar import Registrar
from .result import Detection, FailedRegistration, Hypothesis, PhotographPose, Registration
from .several import register_views

__all__ = [
    "RELIABLE",
    "ContourFit",
    "Detection",
    "Detector",
    "FailedRegistration",
    "Follower",
    "Hypothesis",
    "PhotographPose",
    "Proposals",
    "Registrar",
    "Registration",
    "detect",
    "fit_contours",
    "refine",
    "register_views",
]
