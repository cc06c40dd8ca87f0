"""Images and depth images (B, 1, H, W) to vector fields (B, 2, H, W).

Channel 0 = x, 1 = y; the length is the measure, the direction points across the edge, its sign is
arbitrary. Each function has a module twin with the same options. The dtype is kept (half types
compute in float32). Wrong shapes, dtypes, masks and options raise
:class:`~curvireg_torch.errors.InvalidInputError`.

Grey levels, Gaussians and first derivatives of photographs are kornia's. In graphs, for depth, and
on a CPU where gradients are wanted, sums of shifted images give the same in less time
(``docs/kornia.md`` has the measurements).
"""

from .curvilinear import DepthCurvilinearSaliency as DepthCurvilinearSaliency
from .curvilinear import ImageCurvilinearSaliency as ImageCurvilinearSaliency
from .curvilinear import ImageGradient as ImageGradient
from .curvilinear import PrincipalCurvatureImage as PrincipalCurvatureImage
from .curvilinear import depth_curvilinear_saliency as depth_curvilinear_saliency
from .curvilinear import image_curvilinear_saliency as image_curvilinear_saliency
from .curvilinear import image_gradient as image_gradient
from .curvilinear import principal_curvature_image as principal_curvature_image
from .focus import EdgeBlur as EdgeBlur
from .focus import MultiScaleFocusCurves as MultiScaleFocusCurves
from .focus import edge_blur as edge_blur
from .focus import multiscale_focus_curves as multiscale_focus_curves
from .multiscale import AnisotropicDiffusion as AnisotropicDiffusion
from .multiscale import MultiScaleCurvilinearSaliency as MultiScaleCurvilinearSaliency
from .multiscale import anisotropic_diffusion as anisotropic_diffusion
from .multiscale import multiscale_curvilinear_saliency as multiscale_curvilinear_saliency
from .operations import gaussian_smooth as gaussian_smooth
from .shading import ApparentRidges as ApparentRidges
from .shading import AverageShadingGradient as AverageShadingGradient
from .shading import HessianFrobeniusNorm as HessianFrobeniusNorm
from .shading import apparent_ridges as apparent_ridges
from .shading import average_shading_gradient as average_shading_gradient
from .shading import hessian_frobenius_norm as hessian_frobenius_norm
