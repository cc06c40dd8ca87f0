"""Vector fields (B, 2, H, W) to descriptors (B, D) and point masks (B, 1, H, W).

The dtype is kept (half types compute in float32). Wrong shapes, dtypes and options raise
:class:`~curvireg_torch.errors.InvalidInputError`.
"""

from .hog import HOG, hog, hog_length, orientation_cells
from .points import field_points

__all__ = ["HOG", "field_points", "hog", "hog_length", "orientation_cells"]
