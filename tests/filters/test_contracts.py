"""The layer contract for all filters and HOG, missing depth, compilation, and effects of a change
of the input."""

from typing import ClassVar

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch._dynamo.testing import CompileCounter

from curvireg_torch import camera_matrix, filters

from .._support.layer_contract import SIZE, LayerContract, tensors
from .layer_cases import LAYERS, PAIRS, depths, equal_up_to_sign, photos


class TestLayers(LayerContract):
    cases = tuple(LAYERS.values())

    def gradcheck_weights(self, case, x):
        # At the strongest pixel all levels of MCS are 1, and rounding decides which of them is
        # selected.
        return (
            case(x).norm(dim=1, keepdim=True) < 1.0 - 1e-6 if case.name.startswith("mcs") else 1.0
        )

    def test_autocast_changes_nothing(self, case):
        x = case.inputs(2, SIZE)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            found = tensors(case(x))
        torch.testing.assert_close(found, tensors(case(x)), rtol=0.0, atol=0.0)

    def test_meta_gives_shapes(self, case):
        x = case.inputs(2, SIZE)
        assert case.twin().to("meta")(x.to("meta")).shape == case(x).shape


@pytest.mark.parametrize(
    "layer", [x for x in LAYERS.values() if x.inputs is depths], ids=lambda x: x.name
)
@pytest.mark.parametrize("hole", [torch.nan, torch.inf, -torch.inf, 0.0])
def test_depth_layers_are_finite_with_missing_depth(layer, hole):
    x = depths(2)
    x[0, 0, 10:13, 9:14] = hole
    x[1] = hole  # no visible pixel
    x.requires_grad_()
    y = layer(x)
    y.square().sum().backward()
    assert torch.isfinite(y).all()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()
    assert y[1].detach().abs().max() == 0.0
    far = layer(depths(2))[0, ..., :4]
    assert equal_up_to_sign(y[:1, ..., :4].detach(), far[None], atol=1e-6)


@pytest.mark.slow
class TestCompiled:
    """torch.compile beyond the contract."""

    values: ClassVar = {
        "ig": [{"sigma": s} for s in (1.0, 1.5, 2.3)],
        "cs": [{"depth_scale": s} for s in (1.0, 1.5, 2.3)],
        "hfn": [{"sigma": s, "depth_scale": 2.0 * s} for s in (1.0, 1.5, 2.3)],
        "diffusion": [
            {"iterations": 2, "kappa": k, "step": s}
            for k, s in ((0.03, 0.2), (0.05, 0.1), (0.06, 0.05))
        ],
        "mcs": [{"scales": 2, "kappa": k} for k in (0.03, 0.05, 0.06)],
        "mfc": [{"scales": 2, "saliency_weight": w} for w in (0.5, 0.7, 0.9)],
        "hog": [{"clip": c} for c in (0.2, 0.3, 0.4)],
    }

    @pytest.mark.parametrize("name", ["ig", "cs", "hog"])
    def test_two_graphs_are_enough_for_sizes_beyond_32_px(self, name):
        torch._dynamo.reset()
        function, inputs = PAIRS[name][:2]
        counter = CompileCounter()
        graph = torch.compile(function, fullgraph=True, backend=counter)
        for n, height, width in ((2, 40, 40), (3, 50, 70), (5, 90, 37), (4, 101, 60)):
            x = inputs(n, 101)[..., :height, :width]
            assert LayerContract().agrees(graph(x), function(x))
        assert counter.frame_count == 2

    @pytest.mark.parametrize("name", list(values))
    def test_each_value_of_a_float_option_has_its_graph(self, name):
        """At the second value of a float torch.compile makes it a symbol."""
        torch._dynamo.reset()
        function, inputs = PAIRS[name][:2]
        x = inputs(2, 24)
        counter = CompileCounter()
        graph = torch.compile(function, fullgraph=True, backend=counter)
        for options in self.values[name]:
            assert LayerContract().agrees(graph(x, **options), function(x, **options)), options
        assert counter.frame_count == len(self.values[name])


@pytest.mark.slow
def test_learnt_values_need_one_graph_for_all_steps():
    torch._dynamo.reset()
    module = filters.ImageGradient(learnable=True)
    counter = CompileCounter()
    graph = torch.compile(module, fullgraph=True, backend=counter)
    x = photos(2, 16)
    optimiser = torch.optim.SGD(module.parameters(), lr=0.1)
    seen = []
    for _ in range(3):
        optimiser.zero_grad()
        field = graph(x)
        assert LayerContract().agrees(field, module(x))
        field.square().sum().backward()
        optimiser.step()
        seen.append(float(module.sigma.detach()))
    assert counter.frame_count == 1
    assert len(set(seen)) == 3


FIELDS = [
    x for x in LAYERS.values() if x.name.partition("-")[0] not in ("hog", "diffusion", "blur")
]
# Suppression is strict on one side only, so which of two equal pixels remains depends on the side.
every_field = pytest.mark.parametrize(
    "layer", [x for x in FIELDS if x.name != "ar"], ids=lambda x: x.name
)
few = settings(max_examples=3, deadline=None, derandomize=True)
seeds = st.integers(0, 10_000)


def _input(layer, seed, size=25):
    return layer.inputs(1, size, seed=seed, dtype=torch.float64)


def _close(a, b):
    """Equality up to sign, except for 0.5 % of the vectors at a switch (tied scales, a
    threshold)."""
    scale = float(b.abs().max()) + 1e-12
    off = torch.minimum((a - b).abs().amax(1), (a + b).abs().amax(1)) > 1e-7 * scale
    return float(off.float().mean()) <= 0.005


@every_field
@few
@given(seed=seeds)
def test_fields_rotate_and_mirror_with_the_image(layer, seed):
    x = _input(layer, seed)
    options = dict(layer.options)
    if "camera_matrix" in options:  # one that is centred on the 25 px image, and so as symmetric
        options["camera_matrix"] = camera_matrix(40.0, 40.0, 12.0, 12.0)
    field = layer.function(x, **options)
    vx, vy = torch.rot90(field, 1, (-2, -1)).split(1, dim=1)
    assert _close(
        layer.function(torch.rot90(x, 1, (-2, -1)), **options), torch.cat([vy, -vx], dim=1)
    )
    vx, vy = field.flip(-1).split(1, dim=1)
    assert _close(layer.function(x.flip(-1), **options), torch.cat([-vx, vy], dim=1))


@pytest.mark.parametrize("name", ["cs", "cs-paper", "asg", "hfn"])
@few
@given(seed=seeds, offset=st.floats(0.0, 50.0), factor=st.floats(0.1, 10.0))
def test_depth_fields_with_unit_range_are_invariant_to_offset_and_unit(name, seed, offset, factor):
    layer = LAYERS[name]
    z = _input(layer, seed)
    moved = torch.where(z > 0, factor * (z + offset), 0.0)
    assert _close(layer(moved), layer(z))
