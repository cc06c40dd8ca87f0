"""Filters are kornia's, and sums of shifted images in graphs: both give the same."""

import kornia
import pytest
import torch
from torch.testing import assert_close

from curvireg_torch import filters
from curvireg_torch.filters import operations as ops
from tests._support import double, seeded
from tests._support.spies import spied


def smoothed(sigma, **options):
    return lambda x: ops.smooth(x, sigma, **options)


PRIMITIVES = {
    **{f"sigma {s}": smoothed(s) for s in (0.0, 0.3, 1.0, 2.5, 6.0)},
    "no margin": smoothed(1.3, margin=0),
    "tensor": smoothed(double(1.7)),
    "large tensor": smoothed(double(6.0)),
    "tensor of zero": smoothed(double(0.0)),
}


@pytest.mark.parametrize("name", list(PRIMITIVES))
@pytest.mark.parametrize("shape", [(2, 3, 17, 40), (1, 1, 5, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_give_the_same_with_the_same_derivatives(name, shape, dtype):
    x = torch.rand(shape, generator=seeded(0), dtype=dtype)
    found = []
    for by_kornia in (False, True):
        image = x.clone().requires_grad_()
        with pytest.MonkeyPatch.context() as patch:  # whatever the library prefers
            patch.setattr(ops, "prefers_shifts", lambda *_, shifts=not by_kornia: shifts)
            y = PRIMITIVES[name](image)
        (slope,) = torch.autograd.grad(y.square().sum(), image)
        found.append((y.detach(), slope))
    assert found[0][0].shape == found[1][0].shape
    tolerance = 2e-6 if dtype == torch.float32 else 1e-12
    assert_close(found[1], found[0], rtol=tolerance, atol=tolerance)


@pytest.fixture
def calls(monkeypatch):
    """The calls of kornia's Gaussian."""
    return spied(monkeypatch, kornia.filters, "gaussian_blur2d")


def test_filters_call_kornia_and_graphs_do_not(calls):
    x = torch.rand(1, 1, 16, 16)
    field = filters.image_gradient(x)
    assert len(calls) == 1
    calls.clear()
    filters.depth_curvilinear_saliency(1 + x)  # where rounding decides between directions
    assert not calls
    torch._dynamo.reset()
    graph = torch.compile(filters.image_gradient, fullgraph=True, backend="eager")
    assert_close(graph(x), field)
    assert not calls


def test_kornia_is_not_called_where_gradients_are_wanted(calls):
    """On a CPU: convolutions of one channel have slow gradients."""
    x = torch.rand(1, 1, 16, 16)
    field = filters.image_gradient(x)
    learnable = filters.ImageGradient(learnable=True)
    calls.clear()
    assert_close(filters.image_gradient(x.clone().requires_grad_()), field)
    assert_close(learnable(x), field)
    assert not calls
    with torch.no_grad():
        assert_close(learnable(x), field)
    assert len(calls) == 1


def test_grey_levels_are_those_of_kornia_in_graphs_too():
    x = torch.rand(2, 3, 8, 9)
    assert torch.equal(ops.to_grey(x), kornia.color.rgb_to_grayscale(x))
    torch._dynamo.reset()
    graph = torch.compile(ops.to_grey, fullgraph=True, backend="eager")
    assert_close(graph(x), ops.to_grey(x))
    assert_close(torch.func.vmap(ops.to_grey)(x[None]), ops.to_grey(x)[None])
