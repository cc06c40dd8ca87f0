"""Fields to descriptors and point masks, their whitening, and networks: the learned field and the
ImageNet backbone.

HOG, its points and the learned field keep the dtype (half types compute in float32); wrong images,
fields and options raise :class:`~curvireg_torch.errors.InvalidInputError`.
"""

from .hog import HOG, field_points, hog
from .learned_field import FieldNetwork, LearnedCurvilinearSaliency, doubled_angle, halved_angle
from .whitening import Whitening

__all__ = [
    "HOG",
    "FieldNetwork",
    "LearnedCurvilinearSaliency",
    "Whitening",
    "doubled_angle",
    "field_points",
    "halved_angle",
    "hog",
]
