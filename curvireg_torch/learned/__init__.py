"""The photograph's field, learnt from generated scenes alone."""

from .adapt import adapt
from .lessons import Lessons, Replay, altered, losses
from .network import FieldNetwork, LearnedCurvilinearSaliency, doubled_angle, halved_angle

__all__ = [
    "FieldNetwork",
    "LearnedCurvilinearSaliency",
    "Lessons",
    "Replay",
    "adapt",
    "altered",
    "doubled_angle",
    "halved_angle",
    "losses",
]
