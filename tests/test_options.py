"""Every optional argument of the public surface is keyword-only, and every Module repeats its function's options."""

import inspect

import pytest
from torch import nn

import curvireg_torch as cr

POSITIONAL = {
    "mask",
    "views",
    "thetas",
    "theta",
    "camera_matrices",
    "unit",
}  # options that the documented API gives by position
FUNCTIONS = [n for n in cr.__all__ if inspect.isfunction(getattr(cr, n))]
TWINS = {
    "DepthCurvilinearSaliency": "depth_curvilinear_saliency",
    "ImageCurvilinearSaliency": "image_curvilinear_saliency",
    "ImageGradient": "image_gradient",
    "AnisotropicDiffusion": "anisotropic_diffusion",
    "MultiScaleCurvilinearSaliency": "multiscale_curvilinear_saliency",
    "MultiScaleFocusCurves": "multiscale_focus_curves",
    "EdgeBlur": "edge_blur",
    "HOG": "hog",
    "AverageShadingGradient": "average_shading_gradient",
    "HessianFrobeniusNorm": "hessian_frobenius_norm",
    "ApparentRidges": "apparent_ridges",
    "PrincipalCurvatureImage": "principal_curvature_image",
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_optional_arguments_are_keyword_only(name):
    for parameter in inspect.signature(getattr(cr, name)).parameters.values():
        if parameter.default is not inspect.Parameter.empty and parameter.name not in POSITIONAL:
            assert parameter.kind is inspect.Parameter.KEYWORD_ONLY, parameter.name


@pytest.mark.parametrize(("module", "function"), TWINS.items())
def test_twins_share_options_and_defaults(module, function):
    def options(thing):
        found = inspect.signature(thing).parameters.values()
        return {p.name: p.default for p in found if p.kind is inspect.Parameter.KEYWORD_ONLY}

    assert issubclass(getattr(cr, module), nn.Module)
    # HOG's bin weights are the module's own parameter, as logarithms: learnable=True.
    of_function, of_module = options(getattr(cr, function)), options(getattr(cr, module).__init__)
    of_function.pop("bin_weights", None)
    assert of_function.items() <= of_module.items()
