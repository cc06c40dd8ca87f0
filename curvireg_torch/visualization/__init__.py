"""Pictures of registrations."""

from .overlay import contour_overlay, registration_sheet

__all__ = ["contour_overlay", "registration_sheet"]
