"""Training of the learned field: generated scenes, targets, losses, and adaptation to one mesh."""

from .adaptation import adapt
from .field_dataset import FieldDataset, ReplayBuffer, augment, losses

__all__ = ["FieldDataset", "ReplayBuffer", "adapt", "augment", "losses"]
