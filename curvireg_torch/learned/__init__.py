"""Networks that stand in for a field or a term, and how they were taught.

Lessons need banks and scenes, which need the networks: they are imported when they are asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .network import FieldNetwork, LearnedCurvilinearSaliency, doubled_angle, halved_angle

if TYPE_CHECKING:
    from .adaptation import adapt
    from .lessons import Lessons, Replay, altered, losses

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

_LATE = {"adapt": "adaptation", **dict.fromkeys(("Lessons", "Replay", "altered", "losses"), "lessons")}


def __getattr__(name: str) -> Any:
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_LATE[name]}", __name__), name)
