"""Images and depth images (B, 1, H, W) to vector fields (B, 2, H, W).

Channel 0 = x, 1 = y; the length is the measure, the direction points across the edge, its sign is
arbitrary. Each function has a module twin with the same options. The dtype is kept (half types
compute in float32). Wrong shapes, dtypes, masks and options raise
:class:`~curvireg_torch.errors.InvalidInputError`.

Grey levels and Gaussians of photographs are kornia's. For derivatives and depth, in graphs, and on
a CPU where gradients are wanted, sums of shifted images give the same in less time
(``docs/kornia.md`` has the measurements).
"""

from .curvilinear import (
    DepthCurvilinearSaliency,
    ImageCurvilinearSaliency,
    ImageGradient,
    PrincipalCurvatureImage,
    depth_curvilinear_saliency,
    image_curvilinear_saliency,
    image_gradient,
    principal_curvature_image,
)
from .focus import EdgeBlur, MultiScaleFocusCurves, edge_blur, multiscale_focus_curves
from .multiscale import (
    AnisotropicDiffusion,
    MultiScaleCurvilinearSaliency,
    anisotropic_diffusion,
    multiscale_curvilinear_saliency,
)
from .operations import gaussian_smooth
from .shading import (
    ApparentRidges,
    AverageShadingGradient,
    HessianFrobeniusNorm,
    apparent_ridges,
    average_shading_gradient,
    hessian_frobenius_norm,
)

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
    "depth_curvilinear_saliency",
    "edge_blur",
    "gaussian_smooth",
    "hessian_frobenius_norm",
    "image_curvilinear_saliency",
    "image_gradient",
    "multiscale_curvilinear_saliency",
    "multiscale_focus_curves",
    "principal_curvature_image",
]
