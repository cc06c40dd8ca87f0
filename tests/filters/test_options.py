"""Options: functions and constructors check them alike; masks and cameras broadcast; cameras keep
their dtype."""

import copy
import math
import pickle

import pytest
import torch
from torch import nn
from torch.testing import assert_close

import curvireg_torch as cr
from curvireg_torch import filters
from curvireg_torch.errors import InvalidInputError
from tests._support import double, refused, seeded
from tests._support.tables import text_table

from .layer_cases import CAMERA, PAIRS, depths, photos

WRONG_VALUES = r"""
cs        | {"sigma": -1.0}             | sigma: expected a finite number >= 0, got -1
cs        | {"formula": "x"}            | one of 'geometric', 'paper', 'paper-length', got 'x'
mfc       | {"threshold": 1.0}          | threshold: expected 0 <= threshold < 1, got 1.0
mfc       | {"threshold": -0.1}         | threshold: expected a finite number >= 0
asg       | {"camera_matrix": [[1.0]]}  | camera_matrix: expected a torch\.Tensor, got list
diffusion | {"iterations": 1, "step": 0.3} | step: expected 0 < step <= 0.25
mcs       | {"scales": 2.5}             | scales: expected an integer >= 1, got 2.5
mcs       | {"sigma": "1"}              | sigma: expected a number, got str
blur      | {"reblur_sigmas": 1.0}      | reblur_sigmas: expected a sequence
hog       | {"grid": 8.5}               | grid: expected an integer >= 1, got 8.5
blur      | {"reblur_sigmas": [1.0, 0.0]} | reblur_sigmas
hog       | {"clip": 1.5}               | clip
hog       | {"grid": 2, "block": 3}     | block <= grid
"""
WRONG = [
    *text_table(WRONG_VALUES),
    ("asg", {"camera_matrix": torch.eye(4)}, "camera_matrix: expected shape"),
    (
        "asg",
        {"camera_matrix": torch.eye(3), "depth_scale": 1.0},
        "depth_scale: has no meaning with a camera_matrix",
    ),
]


@pytest.mark.parametrize(
    ("name", "options", "message"), WRONG, ids=[f"{x[0]}-{','.join(x[1])}" for x in WRONG]
)
def test_functions_and_constructors_reject_wrong_options(name, options, message):
    function, inputs, module = PAIRS[name]
    with refused(message) as by_function:
        function(inputs(), **options)
    with pytest.raises(InvalidInputError) as by_module:
        module(**options)
    assert str(by_function.value) == str(by_module.value)


def test_a_wrong_depth_is_named_before_its_camera():
    for depth in (torch.ones(1, 1, 8, 8).numpy(), [[1.0]]):
        with refused("depth: expected a torch.Tensor"):
            filters.average_shading_gradient(depth, camera_matrix=torch.eye(3))


def test_depth_layers_broadcast_masks():
    depth = depths(3)
    mask = torch.rand(24, 24, generator=seeded(0)) < 0.7
    want = filters.depth_curvilinear_saliency(depth, mask.expand(3, 1, 24, 24))
    for broadcastable in (mask, mask[None], mask[None, None]):
        assert torch.equal(filters.depth_curvilinear_saliency(depth, broadcastable), want)
    each = torch.ones(3, 1, 1, 1, dtype=torch.bool)
    assert torch.equal(
        filters.hessian_frobenius_norm(depth, each), filters.hessian_frobenius_norm(depth)
    )
    for wrong in (mask[:23], mask.expand(2, 1, 24, 24), mask[None, None, None], depth, 1.0):
        with refused(r"mask: expected bool of shape \(3, 1, 24, 24\)"):
            filters.average_shading_gradient(depth, wrong)


@pytest.mark.parametrize("module", [filters.AverageShadingGradient, filters.ApparentRidges])
def test_perspective_modules_keep_the_precision_of_their_camera(module):
    camera = CAMERA.clone()
    camera[:2, 2] += 1 / 3  # not representable in half precision
    depth = depths().half()
    want = module(camera_matrix=camera)(depth)
    for half in (
        module(camera_matrix=camera).half(),
        module(camera_matrix=camera).to(torch.bfloat16),
    ):
        assert torch.equal(half.camera_matrix, camera)
        assert torch.equal(half(depth), want)
    empty = module(camera_matrix=camera).to("meta").half()
    assert empty.camera_matrix.is_meta
    assert empty.to_empty(device="cpu").camera_matrix.dtype == torch.float32
    assert module().half().camera_matrix is None
    # float64 would exclude devices that do not have it
    double = module(camera_matrix=camera.double())
    assert double.camera_matrix.dtype == double.double().camera_matrix.dtype == torch.float32
    assert torch.equal(double(depth), want)


# At sigma 1 the kernel is about to grow by a tap, 4e-6 of its sum: enough to disturb a difference
# quotient.
MODULES = {
    "ig": (filters.ImageGradient, {"sigma": 0.9}, photos, {"sigma"}),
    "ics": (filters.ImageCurvilinearSaliency, {"sigma": 0.9}, photos, {"sigma"}),
    "cs": (filters.DepthCurvilinearSaliency, {"sigma": 0.9}, depths, {"sigma"}),
    "diffusion": (filters.AnisotropicDiffusion, {"iterations": 3}, photos, {"kappa"}),
    "mcs": (
        filters.MultiScaleCurvilinearSaliency,
        {"sigma": 0.9, "scales": 3},
        photos,
        {"sigma", "kappa"},
    ),
    "mfc": (filters.MultiScaleFocusCurves, {"sigma": 0.9}, photos, {"sigma"}),
}


def test_tiny_values_count_as_the_smallest():
    x = photos(1, 16)
    gradient = filters.image_gradient
    assert torch.equal(gradient(x, sigma=1e-150), gradient(x, sigma=0.0))
    saliency = filters.depth_curvilinear_saliency
    assert torch.equal(saliency(depths(1), sigma=1e-160), saliency(depths(1), sigma=0.0))
    smallest = filters.anisotropic_diffusion(x, iterations=2, kappa=1e-6)
    assert smallest.isfinite().all()
    assert torch.equal(filters.anisotropic_diffusion(x, iterations=2, kappa=1e-39), smallest)


@pytest.mark.parametrize("name", list(MODULES))
def test_layers_are_built_on_any_default_device_and_compute_on_that_of_the_image(name):
    module, options, inputs, _ = MODULES[name]
    image = inputs(1, 16)
    expected = module(**options)(image)
    with torch.device("meta"):
        assert module(**options)(image).equal(expected)


@pytest.mark.parametrize("name", list(MODULES))
def test_learnable_modules_start_at_their_options_with_correct_gradients(name):
    make, options, inputs, learnable = MODULES[name]
    x = inputs(2, 12, dtype=torch.float64)
    fixed = make(**options)
    module = make(**options, learnable=True).double()
    keys = [f"log_{option}" for option in sorted(learnable)]
    assert sorted(module.state_dict()) == keys
    assert not list(fixed.parameters())
    for option in learnable:  # the float64 number itself, not the one that float32 rounded
        setattr(module, option, double(getattr(fixed, option)))
    assert_close(module(x), fixed(x), rtol=1e-9, atol=1e-12)
    assert_close(copy.deepcopy(module)(x), module(x), rtol=0.0, atol=0.0)
    weights = 1.0
    if name.startswith("mcs"):
        weights = fixed(x).norm(dim=1, keepdim=True) < 1.0 - 1e-6  # all levels are tied at the peak

    def function(*values):
        return (
            torch.func.functional_call(module, dict(zip(keys, values, strict=True)), (x,)) * weights
        )

    parameters = tuple(p for _, p in sorted(module.named_parameters()))
    gradients = torch.autograd.grad(function(*parameters).square().sum(), parameters)
    assert all(float(g) != 0.0 for g in gradients)
    assert torch.autograd.gradcheck(
        function, parameters, eps=1e-7, atol=1e-5, rtol=1e-4, fast_mode=True
    )


@pytest.mark.parametrize("name", list(MODULES))
def test_learnable_modules_can_be_pickled_saved_and_halved(name):
    make, options, inputs, learnable = MODULES[name]
    module = make(**options, learnable=True)
    for option in learnable:
        setattr(module, option, 1.5 * getattr(module, option))
    x = inputs(2, 16)
    pickled = pickle.loads(pickle.dumps(module))
    other = make(**options, learnable=True)
    other.load_state_dict(module.state_dict())
    for one in (pickled, other):
        assert torch.equal(one(x), module(x))
        assert one.options.keys() == module.options.keys()
        assert list(one.state_dict()) == list(module.state_dict())
        assert repr(one) == repr(module)
    half = pickled.half()
    found = half(x.half())
    assert found.dtype == torch.float16
    field = module(x)
    close = (found.float() - field).abs() <= 0.02 * field.abs().max()
    assert close.float().mean() > 0.99
    assert half(x).dtype == torch.float32


def test_states_of_learnable_and_fixed_modules_fit_without_their_options():
    fixed = nn.Sequential(filters.ImageGradient(sigma=2.0), cr.HOG())
    learnt = nn.Sequential(filters.ImageGradient(learnable=True), cr.HOG(learnable=True))
    with refused('"0.log_sigma", "1.log_bin_weights"', RuntimeError):
        fixed.load_state_dict(learnt.state_dict())
    keys = ["0.log_sigma", "1.log_bin_weights"]
    assert fixed.load_state_dict(learnt.state_dict(), strict=False) == ([], keys)
    assert learnt.load_state_dict(fixed.state_dict(), strict=False) == (keys, [])
    assert float(learnt[0].sigma.detach()) == 1.0
    fixed[0].sigma = 3.0
    assert fixed[0].options == {"sigma": 3.0}


@pytest.mark.parametrize(("make", "size"), [(filters.ImageGradient, 1), (cr.HOG, 2)])
def test_learnable_modules_are_replicated_by_data_parallel(make, size):
    module = make(learnable=True)
    x = torch.rand(1, size, 16, 16, generator=seeded(0))
    copied = module._replicate_for_data_parallel()
    for name, parameter in module.named_parameters():
        setattr(copied, name, 1.0 * parameter)  # no parameter, as in torch.nn.parallel.replicate
    assert torch.equal(copied(x), module(x))


def test_learnable_options_reject_values_that_are_not_positive():
    module = filters.ImageGradient(learnable=True)
    for value in (-1.0, 0.0, math.nan, math.inf, torch.tensor(-1.0)):
        with refused("sigma: expected finite values > 0"):
            module.sigma = value
    assert float(module.sigma.detach()) == 1.0
    for call, message in (
        (
            lambda: filters.ImageGradient(sigma=0.0, learnable=True),
            "sigma: expected a finite number > 0, got 0",
        ),
        (
            lambda: filters.AnisotropicDiffusion(iterations=1, kappa=-1.0, learnable=True),
            "kappa: .* > 0, got -1",
        ),
        (
            lambda: filters.image_gradient(photos(), sigma=torch.tensor(-1.0)),
            "sigma: .* >= 0, got -1",
        ),
        (
            lambda: filters.image_gradient(photos(), sigma=torch.ones(2)),
            r"sigma: expected shape \(\), got \(2,\)",
        ),
    ):
        with refused(message):
            call()


@pytest.mark.filterwarnings("ignore:There is a performance drop")
@pytest.mark.parametrize("sigma", [0.0, 0.3, 1.0, 2.5, 4.0, 5.0])
def test_gaussian_smooth_has_the_same_kernel_for_numbers_tensors_and_graphs(sigma):
    """Up to 4 px the kernel of a tensor is that of the number; a larger one is cut at 16 px, traced
    or not."""
    x = photos(1, 40, dtype=torch.float64)
    s = double(sigma)
    by_tensor = filters.gaussian_smooth(x, s)
    if sigma <= 4.0:
        assert_close(by_tensor, filters.gaussian_smooth(x, sigma), rtol=1e-12, atol=0.0)
    # where s cannot be read
    traced = torch.func.vmap(lambda s: filters.gaussian_smooth(x, s))(s[None])[0]
    assert_close(traced, by_tensor, rtol=1e-12, atol=0.0)
    s.requires_grad_()
    (gradient,) = torch.autograd.grad(filters.gaussian_smooth(x, s).square().sum(), s)
    assert torch.isfinite(gradient)
