"""Pictures of registrations."""

from .overlay import contour_overlay, side_pictures
from .pose_glb import pose_glb
from .result_picture import registration_sheet
from .video import OverlayVideo

__all__ = ["OverlayVideo", "contour_overlay", "pose_glb", "registration_sheet", "side_pictures"]
