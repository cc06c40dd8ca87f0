"""torch.compile, torch.export and ONNX."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from curvireg_torch import filters
from curvireg_torch.descriptors import hog

from .layer_cases import LAYERS, NAMES, Layer, depths, fields, photos

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


VALUES: dict[str, tuple[Callable[..., torch.Tensor], Callable[..., torch.Tensor], list[dict[str, object]]]] = {
    "ig": (filters.image_gradient, photos, [{"sigma": s} for s in (1.0, 1.5, 2.3)]),
    "cs": (filters.depth_curvilinear_saliency, depths, [{"depth_scale": s} for s in (1.0, 1.5, 2.3)]),
    "hfn": (filters.hessian_frobenius_norm, depths, [{"sigma": s, "depth_scale": 2.0 * s} for s in (1.0, 1.5, 2.3)]),
    "diffusion": (
        filters.anisotropic_diffusion,
        photos,
        [{"iterations": 2, "kappa": k, "step": s} for k, s in ((0.03, 0.2), (0.05, 0.1), (0.06, 0.05))],
    ),
    "bilateral": (filters.bilateral_smooth, photos, [{"sigma": s} for s in (0.5, 0.7, 0.9)]),
    "mcs": (
        filters.multiscale_curvilinear_saliency,
        photos,
        [{"scales": 2, "diffusion_time": t, "threshold": 0.1 * t} for t in (1.0, 2.0, 3.0)],
    ),
    "mfc": (
        filters.multiscale_focus_curves,
        photos,
        [{"scales": 2, "saliency_weight": w, "threshold": 0.1 * w} for w in (0.5, 0.7, 0.9)],
    ),
    "hog": (hog, fields, [{"clip": c} for c in (0.2, 0.3, 0.4)]),
}


@pytest.mark.parametrize("name", list(VALUES))
def test_every_value_of_a_float_option_compiles(name: str) -> None:
    """At a float's second value torch.compile makes it a symbol."""
    torch._dynamo.reset()
    function, inputs, options = VALUES[name]
    x = inputs(2, 24)
    graph = torch.compile(function, fullgraph=True, backend="eager")
    for some in options:
        assert _agrees(graph(x, **some), function(x, **some)), some


@every_layer
def test_any_size_in_one_graph(layer: Layer) -> None:
    torch._dynamo.reset()
    graph = torch.compile(layer.twin(), fullgraph=True, dynamic=True, backend="eager")
    for n, size in ((2, 24), (3, 30)):
        x = layer.inputs(n, size)
        assert _agrees(graph(x), layer(x))


@pytest.mark.parametrize("dynamic", [None, True])
def test_missing_pixels_in_a_compiled_graph(dynamic: bool | None) -> None:
    torch._dynamo.reset()
    x = photos(2, 24)
    x[0, 0, 3:5, 7:9] = torch.nan
    graph = torch.compile(filters.image_gradient, fullgraph=True, dynamic=dynamic)
    torch.testing.assert_close(graph(x), filters.image_gradient(x), rtol=1e-4, atol=1e-6)


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
    (parameter,) = layer.parameters()
    gradient, parameter.grad = parameter.grad, None
    got = torch.compile(layer, fullgraph=True)(x)
    got.square().sum().backward()
    assert _agrees(got.detach(), want.detach())
    torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-6)
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
