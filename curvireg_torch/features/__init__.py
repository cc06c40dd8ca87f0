"""Fields to descriptors and point masks, and networks: the learned field and the ImageNet backbone.

Descriptors keep the dtype (half types compute in float32). Wrong shapes, dtypes and options raise
:class:`~curvireg_torch.errors.InvalidInputError`.
"""

from .hog import HOG as HOG
from .hog import field_points as field_points
from .hog import hog as hog
from .learned_field import FieldNetwork as FieldNetwork
from .learned_field import LearnedCurvilinearSaliency as LearnedCurvilinearSaliency
from .learned_field import doubled_angle as doubled_angle
from .learned_field import halved_angle as halved_angle
