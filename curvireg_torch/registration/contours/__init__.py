"""The contour fit: projected mesh contours are pulled onto image edges."""

from .fit import ContourFit, contour_support, fit_contours

__all__ = ["ContourFit", "contour_support", "fit_contours"]
