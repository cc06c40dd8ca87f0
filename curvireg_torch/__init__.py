"""Pose of a known 3D object from one ordinary photograph."""

from typing import TYPE_CHECKING

from ._lazy import lazy

if TYPE_CHECKING:
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
        load_mesh,
        paper_views,
        project_points,
        rotation_error,
        rotation_from_viewpoint,
        sample_views,
        uniform_views,
        viewpoint_from_rotation,
    )
    from .learned import LearnedCurvilinearSaliency
    from .location import locate
    from .matching import BankSettings, Ranking, ViewBank, ViewMatcher
    from .pipeline import Pipeline
    from .registration import Registrar, Registration
    from .rendering import render_depth
else:
    __getattr__, __dir__ = lazy(
        __name__,
        {
            "data": "BOPDataset Pascal3DPlus WebCollection",
            "descriptors": "HOG field_points hog",
            "errors": "CurviregError",
            "filters": (
                "AnisotropicDiffusion ApparentRidges AverageShadingGradient DepthCurvilinearSaliency EdgeBlur "
                "HessianFrobeniusNorm ImageCurvilinearSaliency ImageGradient MultiScaleCurvilinearSaliency "
                "MultiScaleFocusCurves PrincipalCurvatureImage anisotropic_diffusion apparent_ridges "
                "average_shading_gradient depth_curvilinear_saliency edge_blur hessian_frobenius_norm "
                "image_curvilinear_saliency image_gradient multiscale_curvilinear_saliency multiscale_focus_curves "
                "principal_curvature_image"
            ),
            "geometry": (
                "ViewSphere camera_matrix crop_images load_mesh paper_views project_points rotation_error "
                "rotation_from_viewpoint sample_views uniform_views viewpoint_from_rotation"
            ),
            "learned": "LearnedCurvilinearSaliency",
            "location": "locate",
            "matching": "BankSettings Ranking ViewBank ViewMatcher",
            "pipeline": "Pipeline",
            "registration": "Registrar Registration",
            "rendering": "render_depth",
        },
    )

__version__ = "0.1.0"

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
