"""Pose of a known 3D object from one ordinary photograph."""

from .descriptors import HOG, field_points, hog
from .errors import CurviregError
from .filters import (
    AnisotropicDiffusion,
    DepthCurvilinearSaliency,
    EdgeBlur,
    ImageCurvilinearSaliency,
    ImageGradient,
    MultiScaleCurvilinearSaliency,
    MultiScaleFocusCurves,
    anisotropic_diffusion,
    depth_curvilinear_saliency,
    edge_blur,
    image_curvilinear_saliency,
    image_gradient,
    multiscale_curvilinear_saliency,
    multiscale_focus_curves,
)
from .geometry import (
    ViewSphere,
    camera_matrix,
    crop_images,
    load_mesh,
    project_points,
    rotation_error,
    rotation_from_viewpoint,
    sample_views,
    uniform_views,
    viewpoint_from_rotation,
)
from .matching import BankSettings, Ranking, ViewBank, ViewMatcher
from .registration import Registrar, Registration
from .rendering import render_depth

__version__ = "0.1.0"

__all__ = [
    "HOG",
    "AnisotropicDiffusion",
    "BankSettings",
    "CurviregError",
    "DepthCurvilinearSaliency",
    "EdgeBlur",
    "ImageCurvilinearSaliency",
    "ImageGradient",
    "MultiScaleCurvilinearSaliency",
    "MultiScaleFocusCurves",
    "Ranking",
    "Registrar",
    "Registration",
    "ViewBank",
    "ViewMatcher",
    "ViewSphere",
    "anisotropic_diffusion",
    "camera_matrix",
    "crop_images",
    "depth_curvilinear_saliency",
    "edge_blur",
    "field_points",
    "hog",
    "image_curvilinear_saliency",
    "image_gradient",
    "load_mesh",
    "multiscale_curvilinear_saliency",
    "multiscale_focus_curves",
    "project_points",
    "render_depth",
    "rotation_error",
    "rotation_from_viewpoint",
    "sample_views",
    "uniform_views",
    "viewpoint_from_rotation",
]
