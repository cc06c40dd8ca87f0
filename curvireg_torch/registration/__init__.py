"""From a ranking of views to poses: registration, refinement, following, and detection without a
box."""

from ..fitting.contour_fit import fit_contours as fit_contours
from ..fitting.measured_fit import ContourFit as ContourFit
from .confidence import RELIABLE as RELIABLE
from .detection import detect as detect
from .detector import Detector as Detector
from .detector import Proposals as Proposals
from .following import Follower as Follower
from .refinement import refine as refine
from .registrar import Registrar as Registrar
from .result import Detection as Detection
from .result import FailedRegistration as FailedRegistration
from .result import Hypothesis as Hypothesis
from .result import PhotographPose as PhotographPose
from .result import Registration as Registration
from .several import register_views as register_views
