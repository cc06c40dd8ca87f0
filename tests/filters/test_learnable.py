"""Options as parameters, and the page that trains them."""

import re
from pathlib import Path

import pytest
import torch
from torch import nn

from curvireg_torch import filters

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
    assert {n for n, _ in module.named_parameters()} == names
    assert not list(fixed.parameters())
    with torch.no_grad():
        for n in names:  # exactly the float64 number, not the one that float32 rounded
            getattr(module, n).fill_(getattr(fixed, n))
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


def test_the_training_page_lowers_its_loss() -> None:
    page = (Path(__file__).parents[2] / "docs" / "training.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    with torch.random.fork_rng():
        names: dict[str, object] = {}
        exec(compile(code, "docs/training.md", "exec"), names)
    losses = names["losses"]
    assert isinstance(losses, list)
    assert losses[-1] < losses[0]
    module = names["depth_side"]
    assert isinstance(module, nn.Module)
    assert all(p.grad is not None and bool(torch.isfinite(p.grad).all()) for p in module.parameters())
    print(f"loss {losses[0]:.3f} -> {losses[-1]:.3f}")
