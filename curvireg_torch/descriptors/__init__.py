"""Vector fields (B, 2, H, W) to descriptors (B, D) and point masks (B, 1, H, W)."""

from .hog import HOG, hog, hog_length, orientation_cells
from .points import field_points

__all__ = ["HOG", "field_points", "hog", "hog_length", "orientation_cells"]
