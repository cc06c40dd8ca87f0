"""From a ranking of views to poses: registration, refinement, following, and detection without a
box."""

from ..fitting.contour_fit import fit_contours as fit_contours
from ..fitting.measured_fit import ContourFit as ContourFit
from ..matching.detector import Detector as Detector
from ..matching.detector import Proposals as Proposals
from .confidence import RELIABLE as RELIABLE
from .detection import detect as detect
from .refinement import refine as refine
from .registrar import Registrar as Registrar
from .result import Detection as Detection
from .result import FailedRegistration as FailedRegistration
from .result import Hypothesis as Hypothesis
from .result import PhotographPose as PhotographPose
from .result import Registration as Registration
from .several import register_views as register_views
from .tracking import Follower as Follower
