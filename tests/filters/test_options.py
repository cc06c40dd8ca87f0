"""Options: functions and constructors check them alike; masks and cameras broadcast; cameras keep their dtype."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from curvireg_torch import filters
from curvireg_torch.errors import InvalidInputError

from .layer_cases import CAMERA, PAIRS, depths

WRONG: list[tuple[str, dict[str, object], str]] = [
    ("cs", {"sigma": -1.0}, "sigma: expected a finite number >= 0, got -1"),
    ("cs", {"formula": "x"}, "formula: expected one of 'geometric', 'paper', got 'x'"),
    ("cs", {"depth_scale": 0.0}, "depth_scale"),
    ("asg", {"sigma": math.nan}, "sigma"),
    ("asg", {"camera_matrix": torch.eye(4)}, "camera_matrix: expected shape"),
    ("asg", {"camera_matrix": torch.eye(3), "depth_scale": 1.0}, "depth_scale: has no meaning with a camera_matrix"),
    ("ar", {"camera_matrix": torch.eye(3), "depth_scale": 1.0}, "depth_scale: has no meaning with a camera_matrix"),
    ("ar", {"depth_scale": -1.0}, "depth_scale"),
    ("hfn", {"depth_scale": math.inf}, "depth_scale"),
    ("ig", {"sigma": -1.0}, "sigma: expected a finite number >= 0, got -1"),
    ("ics", {"sigma": math.inf}, "sigma"),
    ("diffusion", {"iterations": -1}, "iterations"),
    ("diffusion", {"iterations": 1, "step": 0.3}, "step: expected 0 < step <= 0.25"),
    ("diffusion", {"iterations": 1, "step": 0.0}, "step"),
    ("diffusion", {"iterations": 1, "kappa": 0.0}, "kappa"),
    ("mcs", {"scales": 0}, "scales"),
    ("mcs", {"kappa": -1.0}, "kappa"),
    ("mcs", {"threshold": 1.0}, "threshold"),
    ("mcs", {"diffusion_time": 0.0}, "diffusion_time"),
    ("mcs", {"scales": 2.5}, "scales: expected an integer >= 1, got 2.5"),
    ("mcs", {"sigma": "1"}, "sigma: expected a number, got str"),
    ("diffusion", {"iterations": 2.0}, "iterations: expected an integer >= 0"),
    ("mfc", {"scales": 2.5}, "scales: expected an integer >= 2"),
    ("blur", {"reblur_sigmas": 1.0}, "reblur_sigmas: expected a sequence"),
    ("hog", {"grid": 8.5}, "grid: expected an integer >= 1, got 8.5"),
    ("hog", {"block": True}, "block: expected an integer"),
    ("mfc", {"scales": 1}, "scales"),
    ("mfc", {"saliency_weight": -1.0}, "saliency_weight"),
    ("mfc", {"threshold": -1.0}, "threshold"),
    ("blur", {"reblur_sigmas": ()}, "reblur_sigmas"),
    ("blur", {"reblur_sigmas": (1.0, 0.0)}, "reblur_sigmas"),
    ("pci", {"sigmas": (1.0, -1.0)}, "sigmas"),
    ("pci", {"sigmas": ()}, "sigmas"),
    ("hog", {"clip": 1.5}, "clip"),
    ("hog", {"clip": 0.0}, "clip"),
    ("hog", {"bins": 0}, "bins"),
    ("hog", {"voting": "soft"}, "voting"),
    ("hog", {"grid": 2, "block": 3}, "block <= grid"),
]


@pytest.mark.parametrize(("name", "options", "message"), WRONG, ids=[f"{x[0]}-{','.join(x[1])}" for x in WRONG])
def test_functions_and_constructors_reject_wrong_options(name: str, options: dict[str, object], message: str) -> None:
    function, inputs, module = PAIRS[name]
    with pytest.raises(InvalidInputError, match=message) as by_function:
        function(inputs(), **options)
    with pytest.raises(InvalidInputError) as by_module:
        module(**options)
    assert str(by_function.value) == str(by_module.value)


@pytest.mark.parametrize("name", ["cs", "asg", "hfn", "ig", "ics", "mfc"])
def test_layers_accept_sigma_zero(name: str) -> None:
    function, inputs, _ = PAIRS[name]
    assert torch.isfinite(function(inputs(), sigma=0.0)).all()


def test_depth_layers_broadcast_masks() -> None:
    depth = depths(3)
    mask = torch.rand(24, 24, generator=torch.Generator().manual_seed(0)) < 0.7
    want = filters.depth_curvilinear_saliency(depth, mask.expand(3, 1, 24, 24))
    for broadcastable in (mask, mask[None], mask[None, None]):
        assert torch.equal(filters.depth_curvilinear_saliency(depth, broadcastable), want)
    each = torch.ones(3, 1, 1, 1, dtype=torch.bool)
    assert torch.equal(filters.hessian_frobenius_norm(depth, each), filters.hessian_frobenius_norm(depth))
    for wrong in (mask[:23], mask.expand(2, 1, 24, 24), mask[None, None, None], depth):
        with pytest.raises(InvalidInputError, match=r"mask: expected bool of shape \(3, 1, 24, 24\)"):
            filters.average_shading_gradient(depth, wrong)


@pytest.mark.parametrize("layer", [filters.average_shading_gradient, filters.apparent_ridges])
def test_perspective_layers_broadcast_cameras(layer: Callable[..., Tensor]) -> None:
    depth = depths(3)
    want = layer(depth, camera_matrix=CAMERA.expand(3, 3, 3))
    assert torch.equal(layer(depth, camera_matrix=CAMERA), want)
    assert torch.equal(layer(depth, camera_matrix=CAMERA[None]), want)
    with pytest.raises(InvalidInputError, match=r"camera_matrix: expected shape \(3, 3, 3\), got \(2, 3, 3\)"):
        layer(depth, camera_matrix=CAMERA.expand(2, 3, 3))


@pytest.mark.parametrize("module", [filters.AverageShadingGradient, filters.ApparentRidges])
def test_perspective_modules_keep_the_dtype_of_their_camera(module: Callable[..., nn.Module]) -> None:
    camera = CAMERA.clone()
    camera[:2, 2] += 1 / 3  # not representable in half precision
    depth = depths().half()
    want = module(camera_matrix=camera)(depth)
    for half in (module(camera_matrix=camera).half(), module(camera_matrix=camera).to(torch.bfloat16)):
        assert torch.equal(half.camera_matrix, camera)
        assert torch.equal(half(depth), want)
    assert module(camera_matrix=camera).to("meta").camera_matrix.device.type == "meta"
    assert module().half().camera_matrix is None
