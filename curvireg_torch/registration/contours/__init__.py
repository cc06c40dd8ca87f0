"""The contour fit: projected mesh contours are pulled onto image edges."""

from .fit import ContourFit, contour_support, fit_contours
from .texture import fit_texture, turned

__all__ = ["ContourFit", "contour_support", "fit_contours", "fit_texture", "turned"]
