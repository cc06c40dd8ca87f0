"""Pictures of registrations."""

from .overlay import contour_overlay, registration_sheet, side_pictures
from .pose_glb import pose_glb
from .video import OverlayVideo

__all__ = ["OverlayVideo", "contour_overlay", "pose_glb", "registration_sheet", "side_pictures"]
