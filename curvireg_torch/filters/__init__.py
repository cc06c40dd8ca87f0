"""Images and depth images (B, 1, H, W) to vector fields (B, 2, H, W).

Channel 0 = x, 1 = y; the length is the measure, the direction points across the edge, the sign carries no meaning.
"""

from .curvilinear import (
    DepthCurvilinearSaliency,
    ImageCurvilinearSaliency,
    depth_curvilinear_saliency,
    image_curvilinear_saliency,
)
from .derivatives import ImageGradient, gaussian_smooth, image_gradient
from .diffusion import AnisotropicDiffusion, anisotropic_diffusion
from .focus import EdgeBlur, MultiScaleFocusCurves, edge_blur, multiscale_focus_curves
from .multiscale import MultiScaleCurvilinearSaliency, multiscale_curvilinear_saliency

__all__ = [
    "AnisotropicDiffusion",
    "DepthCurvilinearSaliency",
    "EdgeBlur",
    "ImageCurvilinearSaliency",
    "ImageGradient",
    "MultiScaleCurvilinearSaliency",
    "MultiScaleFocusCurves",
    "anisotropic_diffusion",
    "depth_curvilinear_saliency",
    "edge_blur",
    "gaussian_smooth",
    "image_curvilinear_saliency",
    "image_gradient",
    "multiscale_curvilinear_saliency",
    "multiscale_focus_curves",
]
