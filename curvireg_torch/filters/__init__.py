"""Images and depth images (B, 1, H, W) to vector fields (B, 2, H, W).

Channel 0 = x, 1 = y; the length is the measure, the direction points across the edge, its sign is arbitrary. Each
function has a module twin with the same options. The dtype is kept (half types compute in float32). Wrong shapes,
dtypes, masks and options raise :class:`~curvireg_torch.errors.InvalidInputError`.

The bilateral filter is kornia's. These parts are own code, with the time of kornia's as a multiple of ours on one CPU
thread: gradient 27, gradient and Hessian 26, Sobel 14, differences of neighbours in the
diffusion 70, box mean 5.5, guided filter 2.8. Kornia's Gaussian blur (1.0 to 1.3) and grey conversion (0.7)
round differently, and all stored results depend on the rounding, so ours remain.
"""

from .curvilinear import (
    DepthCurvilinearSaliency,
    ImageCurvilinearSaliency,
    depth_curvilinear_saliency,
    image_curvilinear_saliency,
)
from .derivatives import gaussian_smooth
from .diffusion import AnisotropicDiffusion, anisotropic_diffusion
from .edge_preserving import bilateral_smooth, guided_smooth
from .focus import EdgeBlur, MultiScaleFocusCurves, edge_blur, multiscale_focus_curves
from .gradient import ImageGradient, image_gradient
from .multiscale import MultiScaleCurvilinearSaliency, multiscale_curvilinear_saliency
from .principal import PrincipalCurvatureImage, principal_curvature_image
from .ridges import ApparentRidges, apparent_ridges
from .shading import AverageShadingGradient, HessianFrobeniusNorm, average_shading_gradient, hessian_frobenius_norm

__all__ = [
    "AnisotropicDiffusion",
    "ApparentRidges",
    "AverageShadingGradient",
    "DepthCurvilinearSaliency",
    "EdgeBlur",
    "HessianFrobeniusNorm",
    "ImageCurvilinearSaliency",
    "ImageGradient",
    "MultiScaleCurvilinearSaliency",
    "MultiScaleFocusCurves",
    "PrincipalCurvatureImage",
    "anisotropic_diffusion",
    "apparent_ridges",
    "average_shading_gradient",
    "bilateral_smooth",
    "depth_curvilinear_saliency",
    "edge_blur",
    "gaussian_smooth",
    "guided_smooth",
    "hessian_frobenius_norm",
    "image_curvilinear_saliency",
    "image_gradient",
    "multiscale_curvilinear_saliency",
    "multiscale_focus_curves",
    "principal_curvature_image",
]
