"""Pictures of registrations."""

from .overlay import contour_overlay, registration_sheet, side_pictures
from .posed_glb import posed_glb

__all__ = ["contour_overlay", "posed_glb", "registration_sheet", "side_pictures"]
