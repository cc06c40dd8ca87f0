"""From a ranking of views to poses: registration, refinement, following, and detection without a
box."""

from ..fitting.contour_fit import fit_contours
from ..fitting.measured_fit import ContourFit
from ..matching.detector import Detector, Proposals
from .confidence import RELIABLE
from .detection import detect
from .refinement import refine
from .registrar import Registrar
from .result import Detection, FailedRegistration, Hypothesis, PhotographPose, Registration
from .several import register_views
from .tracking import Follower

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
