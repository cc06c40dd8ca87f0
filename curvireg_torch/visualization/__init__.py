"""Pictures of registrations."""

from .overlay import contour_overlay, registration_sheet
from .posed_glb import posed_glb

__all__ = ["contour_overlay", "posed_glb", "registration_sheet"]
