"""Options are checked where they are given; masks and cameras broadcast; half types leave cameras alone."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from curvireg_torch import filters
from curvireg_torch.descriptors import HOG, hog
from curvireg_torch.errors import InvalidInputError

from .layer_cases import CAMERA, depths, fields, photos

CS = (filters.depth_curvilinear_saliency, filters.DepthCurvilinearSaliency, depths)
ASG = (filters.average_shading_gradient, filters.AverageShadingGradient, depths)
AR = (filters.apparent_ridges, filters.ApparentRidges, depths)
HFN = (filters.hessian_frobenius_norm, filters.HessianFrobeniusNorm, depths)
IG = (filters.image_gradient, filters.ImageGradient, photos)
ICS = (filters.image_curvilinear_saliency, filters.ImageCurvilinearSaliency, photos)
DIFFUSION = (filters.anisotropic_diffusion, filters.AnisotropicDiffusion, photos)
MCS = (filters.multiscale_curvilinear_saliency, filters.MultiScaleCurvilinearSaliency, photos)
MFC = (filters.multiscale_focus_curves, filters.MultiScaleFocusCurves, photos)
BLUR = (filters.edge_blur, filters.EdgeBlur, photos)
PCI = (filters.principal_curvature_image, filters.PrincipalCurvatureImage, photos)
DESCRIPTOR = (hog, HOG, fields)
WRONG: list[tuple[tuple[Callable[..., Tensor], Callable[..., nn.Module], Callable[..., Tensor]], dict[str, object]]] = [
    (CS, {"sigma": -1.0}),
    (CS, {"formula": "x"}),
    (CS, {"depth_scale": 0.0}),
    (ASG, {"sigma": math.nan}),
    (ASG, {"camera_matrix": torch.eye(4)}),
    (ASG, {"camera_matrix": torch.eye(3), "depth_scale": 1.0}),
    (AR, {"depth_scale": -1.0}),
    (HFN, {"depth_scale": math.inf}),
    (IG, {"sigma": -1.0}),
    (ICS, {"sigma": math.inf}),
    (DIFFUSION, {"iterations": -1}),
    (DIFFUSION, {"iterations": 1, "step": 0.3}),
    (DIFFUSION, {"iterations": 1, "step": 0.0}),
    (DIFFUSION, {"iterations": 1, "kappa": 0.0}),
    (MCS, {"scales": 0}),
    (MCS, {"kappa": -1.0}),
    (MCS, {"threshold": 1.0}),
    (MCS, {"diffusion_time": 0.0}),
    (MFC, {"scales": 1}),
    (MFC, {"saliency_weight": -1.0}),
    (MFC, {"threshold": -1.0}),
    (BLUR, {"reblur_sigmas": ()}),
    (BLUR, {"reblur_sigmas": (1.0, 0.0)}),
    (PCI, {"sigmas": (1.0, -1.0)}),
    (DESCRIPTOR, {"clip": 1.5}),
    (DESCRIPTOR, {"clip": 0.0}),
    (DESCRIPTOR, {"bins": 0}),
]


@pytest.mark.parametrize(("layer", "options"), WRONG, ids=[f"{x[0].__name__}-{','.join(o)}" for x, o in WRONG])
def test_constructors_check_what_functions_check(
    layer: tuple[Callable[..., Tensor], Callable[..., nn.Module], Callable[..., Tensor]], options: dict[str, object]
) -> None:
    function, module, inputs = layer
    with pytest.raises(InvalidInputError) as by_function:
        function(inputs(), **options)
    with pytest.raises(InvalidInputError) as by_module:
        module(**options)
    assert str(by_function.value) == str(by_module.value)


@pytest.mark.parametrize("layer", [CS, ASG, HFN, IG, ICS, MFC], ids=lambda layer: layer[0].__name__)
def test_no_smoothing_is_allowed(layer: tuple[Callable[..., Tensor], object, Callable[..., Tensor]]) -> None:
    function, _, inputs = layer
    assert torch.isfinite(function(inputs(), sigma=0.0)).all()


def test_masks_broadcast() -> None:
    depth = depths(3)
    mask = torch.rand(24, 24, generator=torch.Generator().manual_seed(0)) < 0.7
    want = filters.depth_curvilinear_saliency(depth, mask.expand(3, 1, 24, 24))
    for some in (mask, mask[None], mask[None, None]):
        assert torch.equal(filters.depth_curvilinear_saliency(depth, some), want)
    each = torch.ones(3, 1, 1, 1, dtype=torch.bool)
    assert torch.equal(filters.hessian_frobenius_norm(depth, each), filters.hessian_frobenius_norm(depth))
    for wrong in (mask[:23], mask.expand(2, 1, 24, 24), mask[None, None, None]):
        with pytest.raises(InvalidInputError, match=r"mask: expected bool of shape \(3, 1, 24, 24\)"):
            filters.average_shading_gradient(depth, wrong)


@pytest.mark.parametrize("layer", [filters.average_shading_gradient, filters.apparent_ridges])
def test_cameras_broadcast(layer: Callable[..., Tensor]) -> None:
    depth = depths(3)
    want = layer(depth, camera_matrix=CAMERA.expand(3, 3, 3))
    assert torch.equal(layer(depth, camera_matrix=CAMERA), want)
    assert torch.equal(layer(depth, camera_matrix=CAMERA[None]), want)
    with pytest.raises(InvalidInputError, match=r"camera_matrix: expected shape \(3, 3, 3\), got \(2, 3, 3\)"):
        layer(depth, camera_matrix=CAMERA.expand(2, 3, 3))


@pytest.mark.parametrize("module", [filters.AverageShadingGradient, filters.ApparentRidges])
def test_half_modules_keep_their_camera(module: Callable[..., nn.Module]) -> None:
    camera = CAMERA.clone()
    camera[:2, 2] += 1 / 3  # no half type has it
    depth = depths().half()
    want = module(camera_matrix=camera)(depth)
    for half in (module(camera_matrix=camera).half(), module(camera_matrix=camera).to(torch.bfloat16)):
        assert torch.equal(half.camera_matrix, camera)
        assert torch.equal(half(depth), want)
    assert module(camera_matrix=camera).to("meta").camera_matrix.device.type == "meta"
    assert module().half().camera_matrix is None
