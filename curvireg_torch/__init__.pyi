from . import (
    data as data,
)
from . import (
    descriptors as descriptors,
)
from . import (
    detectors as detectors,
)
from . import (
    errors as errors,
)
from . import (
    evaluation as evaluation,
)
from . import (
    filters as filters,
)
from . import (
    geometry as geometry,
)
from . import (
    io as io,
)
from . import (
    limits as limits,
)
from . import (
    matching as matching,
)
from . import (
    metrics as metrics,
)
from . import (
    models as models,
)
from . import (
    pipeline as pipeline,
)
from . import (
    registration as registration,
)
from . import (
    rendering as rendering,
)
from . import (
    settings as settings,
)
from . import (
    synthetic as synthetic,
)
from . import (
    terms as terms,
)
from . import (
    training as training,
)
from . import (
    visualization as visualization,
)
from .data import BOPDataset, Pascal3DPlus, WebCollection
from .descriptors import HOG, field_points, hog
from .errors import CurviregError
from .filters import (
    AnisotropicDiffusion,
    ApparentRidges,
    AverageShadingGradient,
    DepthCurvilinearSaliency,
    EdgeBlur,
    HessianFrobeniusNorm,
    ImageCurvilinearSaliency,
    ImageGradient,
    MultiScaleCurvilinearSaliency,
    MultiScaleFocusCurves,
    PrincipalCurvatureImage,
    anisotropic_diffusion,
    apparent_ridges,
    average_shading_gradient,
    depth_curvilinear_saliency,
    edge_blur,
    hessian_frobenius_norm,
    image_curvilinear_saliency,
    image_gradient,
    multiscale_curvilinear_saliency,
    multiscale_focus_curves,
    principal_curvature_image,
)
from .geometry import (
    ViewSphere,
    camera_matrix,
    crop_images,
    paper_views,
    project_points,
    rotation_error,
    rotation_from_viewpoint,
    sample_views,
    uniform_views,
    viewpoint_from_rotation,
)
from .io import load_mesh
from .matching import Ranking, ViewBank, ViewMatcher
from .models import LearnedCurvilinearSaliency
from .pipeline import Pipeline
from .registration import Registrar, Registration, locate
from .rendering import render_depth
from .settings import BankSettings
from .version import __version__ as __version__

__all__ = [
    "HOG",
    "AnisotropicDiffusion",
    "ApparentRidges",
    "AverageShadingGradient",
    "BOPDataset",
    "BankSettings",
    "CurviregError",
    "DepthCurvilinearSaliency",
    "EdgeBlur",
    "HessianFrobeniusNorm",
    "ImageCurvilinearSaliency",
    "ImageGradient",
    "LearnedCurvilinearSaliency",
    "MultiScaleCurvilinearSaliency",
    "MultiScaleFocusCurves",
    "Pascal3DPlus",
    "Pipeline",
    "PrincipalCurvatureImage",
    "Ranking",
    "Registrar",
    "Registration",
    "ViewBank",
    "ViewMatcher",
    "ViewSphere",
    "WebCollection",
    "anisotropic_diffusion",
    "apparent_ridges",
    "average_shading_gradient",
    "camera_matrix",
    "crop_images",
    "depth_curvilinear_saliency",
    "edge_blur",
    "field_points",
    "hessian_frobenius_norm",
    "hog",
    "image_curvilinear_saliency",
    "image_gradient",
    "load_mesh",
    "locate",
    "multiscale_curvilinear_saliency",
    "multiscale_focus_curves",
    "paper_views",
    "principal_curvature_image",
    "project_points",
    "render_depth",
    "rotation_error",
    "rotation_from_viewpoint",
    "sample_views",
    "uniform_views",
    "viewpoint_from_rotation",
]
