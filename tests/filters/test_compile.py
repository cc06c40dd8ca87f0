"""torch.compile, torch.export and ONNX."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from curvireg_torch import filters

from .support import LAYERS, NAMES, Layer, depths, photos

pytestmark = pytest.mark.slow
every_layer = pytest.mark.parametrize("layer", LAYERS, ids=NAMES)


def _agrees(got: torch.Tensor, want: torch.Tensor) -> bool:
    """Other orders of summation flip single pixels where a threshold, a maximum or a sign is at stake."""
    error = (got - want).abs()
    if want.ndim == 4 and want.shape[1] == 2:
        error = torch.minimum(error, (got + want).abs()).amax(dim=1)
    scale = float(want.abs().max())
    return got.shape == want.shape and float((error > 1e-3 * scale).float().mean()) < 0.005


@every_layer
def test_compile_fullgraph(layer: Layer) -> None:
    torch._dynamo.reset()
    x = layer.inputs(2, 24)
    assert _agrees(torch.compile(layer.twin(), fullgraph=True)(x), layer(x))


@pytest.mark.parametrize(
    ("module", "inputs"), [(filters.ImageGradient, photos), (filters.DepthCurvilinearSaliency, depths)]
)
def test_learnable_sigma_compiles_and_exports(
    module: Callable[..., torch.nn.Module], inputs: Callable[..., torch.Tensor]
) -> None:
    torch._dynamo.reset()
    layer, x = module(sigma=1.7, learnable=True), inputs(2, 24)
    want = layer(x)
    want.square().sum().backward()
    gradient, layer.sigma.grad = layer.sigma.grad, None
    got = torch.compile(layer, fullgraph=True)(x)
    got.square().sum().backward()
    assert _agrees(got.detach(), want.detach())
    torch.testing.assert_close(layer.sigma.grad, gradient, rtol=1e-3, atol=1e-6)
    assert _agrees(torch.export.export(layer, (x,)).module()(x).detach(), want.detach())


@every_layer
def test_export_with_any_batch(layer: Layer) -> None:
    batch = torch.export.Dim("batch", min=1, max=64)
    program = torch.export.export(layer.twin(), (layer.inputs(3, 24),), dynamic_shapes=({0: batch},))
    for n in (2, 5):
        x = layer.inputs(n, 24, seed=7)
        assert _agrees(program.module()(x), layer(x))


@every_layer
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
def test_onnxruntime_computes_the_same(layer: Layer, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    path = tmp_path / "layer.onnx"
    x = layer.inputs(2, 24)
    torch.onnx.export(layer.twin().eval(), (x,), path, dynamo=True, verbose=False)
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (got,) = session.run(None, {session.get_inputs()[0].name: x.numpy()})
    assert _agrees(torch.from_numpy(got), layer(x))
