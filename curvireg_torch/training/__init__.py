"""Training of the learned field: generated scenes, datasets and losses, and adaptation to one mesh."""

from .adaptation import adapt
from .field_dataset import Lessons, Replay, altered, losses

__all__ = ["Lessons", "Replay", "adapt", "altered", "losses"]
