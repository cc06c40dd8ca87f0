"""From a ranking of views to poses: registration, refinement, following, and detection without a box."""

from .confidence import RELIABLE
from .contour_fit import ContourFit, fit_contours
from .following import Follower
from .localization import Located, Locator, localize, locate, representative_views
from .refinement import refine
from .registrar import Registrar
from .result import FailedRegistration, Hypothesis, Localization, PhotographPose, Registration
from .several import register_views

__all__ = [
    "RELIABLE",
    "ContourFit",
    "FailedRegistration",
    "Follower",
    "Hypothesis",
    "Localization",
    "Located",
    "Locator",
    "PhotographPose",
    "Registrar",
    "Registration",
    "fit_contours",
    "localize",
    "locate",
    "refine",
    "register_views",
    "representative_views",
]
