"""Options as parameters, and the page that trains them."""

import math
import re
from pathlib import Path

import pytest
import torch
from torch import nn

from curvireg_torch import filters
from curvireg_torch.errors import InvalidInputError

from .support import depths, photos

# At sigma 1 the kernel is about to grow by a tap, 4e-6 of its sum: enough to disturb a difference quotient.
MODULES = {
    "ig": (filters.ImageGradient, {"sigma": 0.9}, photos, {"sigma"}),
    "ics": (filters.ImageCurvilinearSaliency, {"sigma": 0.9}, photos, {"sigma"}),
    "cs": (filters.DepthCurvilinearSaliency, {"sigma": 0.9}, depths, {"sigma"}),
    "diffusion": (filters.AnisotropicDiffusion, {"iterations": 3}, photos, {"kappa"}),
    "mcs": (filters.MultiScaleCurvilinearSaliency, {"sigma": 0.9, "scales": 3}, photos, {"sigma", "kappa"}),
    "mcs-guided": (
        filters.MultiScaleCurvilinearSaliency,
        {"sigma": 0.9, "scales": 3, "smoothing": "guided"},
        photos,
        {"sigma", "kappa"},
    ),
    "mfc": (filters.MultiScaleFocusCurves, {"sigma": 0.9}, photos, {"sigma"}),
}


@pytest.mark.parametrize("name", list(MODULES))
def test_parameters_start_at_the_option_and_get_the_right_gradient(name: str) -> None:
    make, options, inputs, names = MODULES[name]
    x = inputs(2, 12, dtype=torch.float64)
    fixed, module = make(**options), make(**options, learnable=True).double()
    names = {f"log_{n}" for n in names}
    assert {n for n, _ in module.named_parameters()} == names
    assert not list(fixed.parameters())
    with torch.no_grad():
        for n in names:  # exactly the float64 number, not the one that float32 rounded
            getattr(module, n).fill_(math.log(getattr(fixed, n[4:])))
    torch.testing.assert_close(module(x), fixed(x), rtol=1e-9, atol=1e-12)
    weights: float | torch.Tensor = 1.0
    if name.startswith("mcs"):
        weights = fixed(x).norm(dim=1, keepdim=True) < 1.0 - 1e-6  # ties of levels at the peak

    def function(*values: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(module, dict(zip(sorted(names), values, strict=True)), (x,)) * weights

    parameters = tuple(getattr(module, n) for n in sorted(names))
    gradients = torch.autograd.grad(function(*parameters).square().sum(), parameters)
    assert all(float(g) != 0.0 for g in gradients)
    assert torch.autograd.gradcheck(function, parameters, eps=1e-7, atol=1e-5, rtol=1e-4, fast_mode=True)


@pytest.mark.parametrize("name", list(MODULES))
def test_no_step_leads_out_of_the_positive_numbers(name: str) -> None:
    """After far too large a step the module still computes numbers, and its parameters keep learning."""
    make, options, inputs, names = MODULES[name]
    x = inputs(1, 12)
    module = make(**options, learnable=True)
    for log in (-3.0, -60.0, 60.0):
        for n in names:
            parameter = getattr(module, f"log_{n}")
            parameter.data.fill_(log)
            parameter.grad = None
        out = module(x)
        assert torch.isfinite(out).all()
        out.square().sum().backward()
        for n in names:
            assert float(getattr(module, n).detach()) > 0.0
            gradient = getattr(module, f"log_{n}").grad  # not detached from the graph
            assert gradient is not None
            assert bool(torch.isfinite(gradient))


def test_what_must_be_positive_to_be_learnt_says_so() -> None:
    with pytest.raises(InvalidInputError, match="sigma: expected a finite number > 0, got 0"):
        filters.ImageGradient(sigma=0.0, learnable=True)
    with pytest.raises(InvalidInputError, match="kappa: expected a finite number > 0, got -1"):
        filters.AnisotropicDiffusion(iterations=1, kappa=-1.0, learnable=True)
    with pytest.raises(InvalidInputError, match="sigma: expected a finite number >= 0, got -1"):
        filters.image_gradient(photos(), sigma=torch.tensor(-1.0))
    with pytest.raises(InvalidInputError, match=r"sigma: expected shape \(\), got \(2,\)"):
        filters.image_gradient(photos(), sigma=torch.ones(2))


@pytest.mark.filterwarnings("ignore:There is a performance drop")
@pytest.mark.parametrize("sigma", [0.0, 0.3, 1.0, 2.5, 4.0, 5.0])
def test_one_support_rule_for_numbers_tensors_and_graphs(sigma: float) -> None:
    """Up to 4 px a tensor's kernel is the number's; a larger one is cut at 16 px, in a graph as outside."""
    x, s = photos(1, 40, dtype=torch.float64), torch.tensor(sigma, dtype=torch.float64)
    by_tensor = filters.gaussian_smooth(x, s)
    if sigma <= 4.0:
        torch.testing.assert_close(by_tensor, filters.gaussian_smooth(x, sigma), rtol=1e-12, atol=0.0)
    in_graph = torch.func.vmap(lambda s: filters.gaussian_smooth(x, s))(s[None])[0]  # where s cannot be read
    torch.testing.assert_close(in_graph, by_tensor, rtol=1e-12, atol=0.0)
    s.requires_grad_()
    (gradient,) = torch.autograd.grad(filters.gaussian_smooth(x, s).square().sum(), s)
    assert bool(torch.isfinite(gradient))


@pytest.mark.filterwarnings("ignore:There is a performance drop")
def test_many_sigmas_at_once() -> None:
    x, sigmas = photos(1, 24, dtype=torch.float64), torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)
    got = torch.func.vmap(lambda s: filters.image_gradient(x, sigma=s))(sigmas)
    want = torch.stack([filters.image_gradient(x, sigma=float(s)) for s in sigmas])
    torch.testing.assert_close(got, want, rtol=1e-10, atol=1e-12)


def test_the_training_page_lowers_its_loss() -> None:
    page = (Path(__file__).parents[2] / "docs" / "training.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    with torch.random.fork_rng(devices=[]):
        names: dict[str, object] = {}
        exec(compile(code, "docs/training.md", "exec"), names)
    losses = names["losses"]
    assert isinstance(losses, list)
    assert losses[-1] < losses[0]
    module = names["depth_side"]
    assert isinstance(module, nn.Module)
    assert all(p.grad is not None and bool(torch.isfinite(p.grad).all()) for p in module.parameters())
    print(f"loss {losses[0]:.3f} -> {losses[-1]:.3f}")
