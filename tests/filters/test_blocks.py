"""Batches that are cut into blocks are ordinary to every transform and every tensor method."""

import pytest
import torch

from curvireg_torch import filters

from .layer_cases import LAYERS, Layer

SOME = ("cs", "asg-perspective", "ig", "blur", "hog")


@pytest.mark.parametrize("layer", [x for x in LAYERS if x.name in SOME], ids=lambda x: x.name)
@pytest.mark.filterwarnings("ignore:There is a performance drop")
def test_blocks_pass_every_transform(layer: Layer, monkeypatch: pytest.MonkeyPatch) -> None:
    """vmap, and forward derivatives of torch.func and of autograd."""
    x = layer.inputs(3, dtype=torch.float64)
    direction = torch.randn(x.shape, dtype=x.dtype, generator=torch.Generator().manual_seed(0))
    want, slope = torch.func.jvp(layer, (x,), (direction,))
    half = layer(0.5 * x)
    monkeypatch.setattr("curvireg_torch.filters.blocks.BLOCK", 24 * 24)
    got, got_slope = torch.func.jvp(layer, (x,), (direction,))
    torch.testing.assert_close((got, got_slope), (want, slope))
    torch.testing.assert_close(torch.func.vmap(layer)(torch.stack([x, 0.5 * x])), torch.stack([want, half]))
    with torch.autograd.forward_ad.dual_level():
        dual = layer(torch.autograd.forward_ad.make_dual(x, direction))
        torch.testing.assert_close(tuple(torch.autograd.forward_ad.unpack_dual(dual)), (want, slope))


def test_a_large_result_can_be_resized() -> None:
    y = filters.image_gradient(torch.rand(65, 1, 256, 256), sigma=0.0)
    assert y.resize_(70, 2, 256, 256).shape[0] == 70
