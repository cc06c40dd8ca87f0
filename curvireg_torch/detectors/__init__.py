"""The 2D detectors that the paper compares, with one interface: photograph in, response map and feature points out.

``DETECTORS[name](image, fraction=0.04)`` takes (B, 1, H, W) grey levels in [0, 1], or (B, 3, H, W) RGB, and returns a
:class:`Detection`. NaN pixels are filled from their surroundings and have no detections.
"""

from collections.abc import Callable

from ..utils.registry import Registry
from .base import Detection
from .edges import canny, fuzzy_edges, laplacian_of_gaussian, sobel
from .fast_hessian import fast_hessian
from .fields import focus_curves, gradient, multiscale_saliency, principal_curvature
from .keypoints import harris, minimum_eigenvalue, sift
from .response import Response

__all__ = [
    "DETECTORS",
    "Detection",
    "Response",
    "canny",
    "fast_hessian",
    "focus_curves",
    "fuzzy_edges",
    "gradient",
    "harris",
    "laplacian_of_gaussian",
    "minimum_eigenvalue",
    "multiscale_saliency",
    "principal_curvature",
    "sift",
    "sobel",
]

DETECTORS: Registry[Callable[..., Detection]] = Registry(
    "detector",
    {
        "mfc": focus_curves,
        "mcs": multiscale_saliency,
        "ig": gradient,
        "pci": principal_curvature,
        "sobel": sobel,
        "log": laplacian_of_gaussian,
        "canny": canny,
        "fuzzy": fuzzy_edges,
        "harris": harris,
        "mineig": minimum_eigenvalue,
        "sift": sift,
        "surf": fast_hessian,
    },
)
"""Every detector of the comparison by its short name, the detectors of the paper first."""
