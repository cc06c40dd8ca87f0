"""Learnable options: parametrized by their logarithm, with correct gradients."""

import copy

import pytest
import torch
from torch import nn

from curvireg_torch import filters
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.features import HOG

from .layer_cases import depths, photos

# At sigma 1 the kernel is about to grow by a tap, 4e-6 of its sum: enough to disturb a difference quotient.
MODULES = {
    "ig": (filters.ImageGradient, {"sigma": 0.9}, photos, {"sigma"}),
    "ics": (filters.ImageCurvilinearSaliency, {"sigma": 0.9}, photos, {"sigma"}),
    "cs": (filters.DepthCurvilinearSaliency, {"sigma": 0.9}, depths, {"sigma"}),
    "diffusion": (filters.AnisotropicDiffusion, {"iterations": 3}, photos, {"kappa"}),
    "mcs": (filters.MultiScaleCurvilinearSaliency, {"sigma": 0.9, "scales": 3}, photos, {"sigma", "kappa"}),
    "mfc": (filters.MultiScaleFocusCurves, {"sigma": 0.9}, photos, {"sigma"}),
}


@pytest.mark.parametrize("name", list(MODULES))
def test_learnable_modules_start_at_their_options_with_correct_gradients(name: str) -> None:
    make, options, inputs, learnable = MODULES[name]
    x = inputs(2, 12, dtype=torch.float64)
    fixed, module = make(**options), make(**options, learnable=True).double()
    keys = [f"parametrizations.{option}.original" for option in sorted(learnable)]
    assert sorted(module.state_dict()) == keys
    assert not list(fixed.parameters())
    for option in learnable:  # the float64 number itself, not the one that float32 rounded
        setattr(module, option, torch.tensor(getattr(fixed, option), dtype=torch.float64))
    torch.testing.assert_close(module(x), fixed(x), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(copy.deepcopy(module)(x), module(x), rtol=0.0, atol=0.0)
    weights: float | torch.Tensor = 1.0
    if name.startswith("mcs"):
        weights = fixed(x).norm(dim=1, keepdim=True) < 1.0 - 1e-6  # all levels are tied at the peak

    def function(*values: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(module, dict(zip(keys, values, strict=True)), (x,)) * weights

    parameters = tuple(p for _, p in sorted(module.named_parameters()))
    gradients = torch.autograd.grad(function(*parameters).square().sum(), parameters)
    assert all(float(g) != 0.0 for g in gradients)
    assert torch.autograd.gradcheck(function, parameters, eps=1e-7, atol=1e-5, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("name", list(MODULES))
def test_learnable_modules_stay_positive_and_finite_after_large_steps(name: str) -> None:
    make, options, inputs, learnable = MODULES[name]
    x = inputs(1, 12)
    module = make(**options, learnable=True)
    for log in (-3.0, -60.0, 60.0):
        for parameter in module.parameters():
            parameter.data.fill_(log)
            parameter.grad = None
        out = module(x)
        assert torch.isfinite(out).all()
        out.square().sum().backward()
        assert all(float(getattr(module, option).detach()) > 0.0 for option in learnable)
        for parameter in module.parameters():
            assert parameter.grad is not None
            assert bool(torch.isfinite(parameter.grad))


def test_learnable_options_reject_values_that_are_not_positive() -> None:
    for call, message in (
        (lambda: filters.ImageGradient(sigma=0.0, learnable=True), "sigma: expected a finite number > 0, got 0"),
        (lambda: filters.AnisotropicDiffusion(iterations=1, kappa=-1.0, learnable=True), "kappa: .* > 0, got -1"),
        (lambda: filters.image_gradient(photos(), sigma=torch.tensor(-1.0)), "sigma: .* >= 0, got -1"),
        (lambda: filters.image_gradient(photos(), sigma=torch.ones(2)), r"sigma: expected shape \(\), got \(2,\)"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            call()


@pytest.mark.filterwarnings("ignore:There is a performance drop")
@pytest.mark.parametrize("sigma", [0.0, 0.3, 1.0, 2.5, 4.0, 5.0])
def test_gaussian_smooth_has_the_same_kernel_for_numbers_tensors_and_graphs(sigma: float) -> None:
    """Up to 4 px the kernel of a tensor is that of the number; a larger one is cut at 16 px, traced or not."""
    x, s = photos(1, 40, dtype=torch.float64), torch.tensor(sigma, dtype=torch.float64)
    by_tensor = filters.gaussian_smooth(x, s)
    if sigma <= 4.0:
        torch.testing.assert_close(by_tensor, filters.gaussian_smooth(x, sigma), rtol=1e-12, atol=0.0)
    traced = torch.func.vmap(lambda s: filters.gaussian_smooth(x, s))(s[None])[0]  # where s cannot be read
    torch.testing.assert_close(traced, by_tensor, rtol=1e-12, atol=0.0)
    s.requires_grad_()
    (gradient,) = torch.autograd.grad(filters.gaussian_smooth(x, s).square().sum(), s)
    assert bool(torch.isfinite(gradient))


@pytest.mark.filterwarnings("ignore:There is a performance drop")
def test_image_gradient_under_vmap_over_sigma() -> None:
    x, sigmas = photos(1, 24, dtype=torch.float64), torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    got = torch.func.vmap(lambda s: filters.image_gradient(x, sigma=s))(sigmas)
    want = torch.stack([filters.image_gradient(x, sigma=float(s)) for s in sigmas])
    torch.testing.assert_close(got, want, rtol=1e-10, atol=1e-12)


def test_learnable_layers_and_hog_lower_a_matching_loss() -> None:
    """Descriptors of photographs approach those of their depth images."""
    photograph_side = nn.Sequential(filters.ImageGradient(learnable=True), HOG(grid=4, learnable=True))
    depth_side = nn.Sequential(filters.DepthCurvilinearSaliency(learnable=True), HOG(grid=4, learnable=True))
    depth = depths(4, 32)
    photograph = depth + 0.05 * torch.rand(depth.shape, generator=torch.Generator().manual_seed(0))
    parameters = [*photograph_side.parameters(), *depth_side.parameters()]
    optimiser, losses = torch.optim.Adam(parameters, lr=0.03), []
    for _ in range(20):
        query, view = (nn.functional.normalize(x) for x in (photograph_side(photograph), depth_side(depth)))
        loss = nn.functional.cross_entropy(query @ view.T / 0.1, torch.arange(4))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0]
    assert all(p.grad is not None and bool(torch.isfinite(p.grad).all()) for p in parameters)
