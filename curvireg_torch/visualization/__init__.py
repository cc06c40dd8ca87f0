"""Pictures of registrations."""

from .overlay import contour_overlay, registration_sheet, side_pictures
from .pose_glb import pose_glb

__all__ = ["contour_overlay", "pose_glb", "registration_sheet", "side_pictures"]
