"""What every layer promises, whatever it computes."""

import inspect

import pytest
import torch

from curvireg_torch import filters
from curvireg_torch.errors import InvalidInputError

from .layer_cases import LAYERS, NAMES, Layer, depths, equal_up_to_sign, photos

every_layer = pytest.mark.parametrize("layer", LAYERS, ids=NAMES)
every_filter = pytest.mark.parametrize("layer", [x for x in LAYERS if "hog" not in x.name], ids=lambda x: x.name)


@every_layer
def test_module_and_function_agree_and_leave_the_input_alone(layer: Layer) -> None:
    x = layer.inputs()
    before = x.clone()
    torch.testing.assert_close(layer.twin()(x), layer(x), rtol=0.0, atol=0.0)
    assert torch.equal(x, before)
    assert type(layer.twin()).__name__ in repr(layer.twin())


@every_layer
def test_options_are_keyword_only(layer: Layer) -> None:
    for call in (layer.function, layer.module.__init__):
        for name, parameter in inspect.signature(call).parameters.items():
            if parameter.default is not inspect.Parameter.empty and name != "mask":
                assert parameter.kind is inspect.Parameter.KEYWORD_ONLY, name


@every_layer
def test_batched_equals_one_by_one(layer: Layer) -> None:
    """Images of very different contrast and depth range, so that a normalisation over the batch would show."""
    x = layer.inputs(3, dtype=torch.float64) * torch.tensor([1.0, 0.1, 0.0], dtype=torch.float64).view(-1, 1, 1, 1)
    alone = torch.cat([layer(image[None]) for image in x])
    torch.testing.assert_close(layer(x), alone, rtol=1e-6, atol=1e-9)


def test_blocks_are_invisible(monkeypatch: pytest.MonkeyPatch) -> None:
    x = depths(5)
    mask = x > 2.4
    want = filters.depth_curvilinear_saliency(x, mask)
    monkeypatch.setattr("curvireg_torch.filters.blocks.BLOCK", 2 * 24 * 24)
    torch.testing.assert_close(filters.depth_curvilinear_saliency(x, mask), want)
    torch.testing.assert_close(
        filters.average_shading_gradient(x), torch.cat([filters.average_shading_gradient(i[None]) for i in x])
    )
    x.requires_grad_()
    trained = filters.depth_curvilinear_saliency(x, mask)
    torch.testing.assert_close(trained, want)
    (gradient,) = torch.autograd.grad(trained.square().sum(), x)
    assert gradient[1:].abs().amax(dim=(1, 2, 3)).min() > 0  # every block's


def test_a_large_result_is_an_ordinary_tensor() -> None:
    x = torch.rand(65, 1, 256, 256)
    y = filters.image_gradient(x, sigma=0.0)
    assert y.element_size() * y.numel() > 2**25
    torch.testing.assert_close(y[-1], filters.image_gradient(x[-1:], sigma=0.0)[0])
    assert y.is_contiguous()
    assert not y.requires_grad
    y.zero_()
    assert not y.any()


@every_layer
def test_empty_batch(layer: Layer) -> None:
    empty = layer(layer.inputs(2)[:0])
    assert empty.shape == (0, *layer(layer.inputs(2)).shape[1:])


@every_layer
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_dtype_is_kept(layer: Layer, dtype: torch.dtype) -> None:
    x = layer.inputs().to(dtype)
    y = layer(x)
    assert y.dtype == dtype
    # Half types compute in float32: the result is that of the rounded input.
    if dtype is not torch.float64:
        torch.testing.assert_close(y, layer(x.float()).to(dtype), rtol=0.0, atol=0.0)


@every_layer
def test_autocast_changes_nothing(layer: Layer) -> None:
    x = layer.inputs()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = layer(x)
    assert y.dtype == torch.float32
    torch.testing.assert_close(y, layer(x), rtol=0.0, atol=0.0)


@every_layer
def test_no_float64_inside(layer: Layer) -> None:
    """Devices without float64 (MPS) run every layer: no operation on float32 input makes a float64 tensor."""

    class NoDouble(torch.utils._python_dispatch.TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            out = func(*args, **(kwargs or {}))
            for t in out if isinstance(out, tuple | list) else (out,):
                # Python numbers become 0-dim float64 tensors, which MPS takes.
                assert not (isinstance(t, torch.Tensor) and t.dtype is torch.float64 and t.ndim > 0), func
            return out

    x = layer.inputs()
    with NoDouble():
        layer(x)


@every_layer
def test_gradcheck(layer: Layer) -> None:
    """At generic points, where no maximum, threshold or suppression switches within the step."""
    x = layer.inputs(1, 9, seed=3, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    x = x + 0.05 * torch.rand(x.shape, generator=generator, dtype=torch.float64) * (x > 0)
    options = {"grid": 4} if "hog" in layer.name else {}
    # Background pixels are constants: a step there would make them visible.
    where = (x > 0).nonzero(as_tuple=True) if layer.inputs is depths else torch.ones_like(x).nonzero(as_tuple=True)
    weights: float | torch.Tensor = 1.0
    if layer.name.startswith("mcs"):
        # Where the image is strongest every level is 1, and which of them wins is left to rounding.
        weights = layer(x).norm(dim=1, keepdim=True) < 1.0 - 1e-6

    def function(values: torch.Tensor) -> torch.Tensor:
        return layer.function(x.index_put(where, values), **layer.options, **options) * weights

    assert float(function(x[where]).abs().max()) > 0.0
    assert torch.autograd.gradcheck(function, x[where].requires_grad_(), eps=1e-7, atol=1e-5, rtol=1e-4, fast_mode=True)


def _strange_inputs() -> dict[str, torch.Tensor]:
    x = torch.arange(16.0)
    return {
        "zeros": torch.zeros(1, 1, 16, 16),
        "constant": torch.full((1, 1, 16, 16), 0.7),
        "one pixel": torch.full((1, 1, 1, 1), 0.5),
        "one bright pixel": torch.zeros(1, 1, 16, 16).index_put(
            (*(torch.tensor([i]) for i in (0, 0, 8, 8)),), torch.ones(1)
        ),
        "checkerboard": ((x[:, None] + x) % 2)[None, None],
        "saturated": photos(1, 16).mul(3.0).clamp(max=1.0),
        "two levels": (x >= 8).float().expand(1, 1, 16, 16).contiguous(),
        "row": torch.rand(1, 1, 1, 16, generator=torch.Generator().manual_seed(0)),
    }


@every_filter
@pytest.mark.parametrize("case", list(_strange_inputs()))
def test_outputs_and_gradients_are_finite(layer: Layer, case: str) -> None:
    x = _strange_inputs()[case].requires_grad_()
    y = layer(x)
    assert torch.isfinite(y).all()
    y.square().sum().add(y.sum()).backward()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()
    if case in ("zeros", "constant") and layer.name not in (
        "diffusion",
        "diffusion-exponential",
        "blur",
        "blur-saliency",
    ):
        assert float(y.detach().abs().max()) < 1e-6


@pytest.mark.parametrize("layer", [x for x in LAYERS if x.inputs is depths], ids=lambda x: x.name)
@pytest.mark.parametrize("hole", [torch.nan, torch.inf, -torch.inf, 0.0])
def test_holes_in_the_depth_leak_into_no_number(layer: Layer, hole: float) -> None:
    x = depths(2)
    x[0, 0, 10:13, 9:14] = hole
    x[1] = hole  # nothing visible at all
    x.requires_grad_()
    y = layer(x)
    y.square().sum().backward()
    assert torch.isfinite(y).all()
    assert x.grad is not None
    assert torch.isfinite(x.grad).all()
    assert float(y[1].detach().abs().max()) == 0.0
    far = layer(depths(2))[0, ..., :4]
    assert equal_up_to_sign(y[:1, ..., :4].detach(), far[None], atol=1e-6)


def test_bad_input_is_refused_with_expected_and_actual() -> None:
    image, depth = photos(), depths()
    with pytest.raises(InvalidInputError, match=r"image: expected 1 \(grey\) or 3 \(RGB\) channels, got 2"):
        filters.image_gradient(image.expand(2, 2, 24, 24))
    with pytest.raises(InvalidInputError, match=r"depth: expected shape \(\*, 1, \*, \*\), got \(2, 3, 24, 24\)"):
        filters.hessian_frobenius_norm(depth.expand(2, 3, 24, 24))
    with pytest.raises(InvalidInputError, match=r"expected a floating dtype, got torch\.uint8"):
        filters.multiscale_focus_curves(image.byte())
    with pytest.raises(InvalidInputError, match="formula: expected one of 'geometric', 'paper', got 'x'"):
        filters.DepthCurvilinearSaliency(formula="x")
    with pytest.raises(InvalidInputError, match="mask: expected bool"):
        filters.hessian_frobenius_norm(depth, depth)
    with pytest.raises(InvalidInputError, match="smoothing: expected one of"):
        filters.multiscale_curvilinear_saliency(image, smoothing="median")
    with pytest.raises(InvalidInputError, match="diffusion_time"):
        filters.multiscale_curvilinear_saliency(image, diffusion_time=0.0)
    with pytest.raises(InvalidInputError, match="camera_matrix: expected shape"):
        filters.average_shading_gradient(depth, camera_matrix=torch.eye(4))
    with pytest.raises(InvalidInputError, match="depth_scale: has no meaning with a camera_matrix"):
        filters.apparent_ridges(depth, camera_matrix=torch.eye(3), depth_scale=1.0)
    with pytest.raises(InvalidInputError, match="sigma: expected a finite number >= 0, got -1"):
        filters.image_gradient(image, sigma=-1.0)
    with pytest.raises(InvalidInputError, match="sigmas"):
        filters.principal_curvature_image(image, sigmas=())
    with pytest.raises(InvalidInputError, match=r"step: expected 0 < step <= 0.25"):
        filters.anisotropic_diffusion(image, iterations=1, step=0.3)


@every_layer
@pytest.mark.filterwarnings("ignore:There is a performance drop")  # torch's, in the name of whoever calls it
def test_function_transforms(layer: Layer) -> None:
    x = layer.inputs(2, dtype=torch.float64)
    stack = torch.stack([x, 0.5 * x])
    torch.testing.assert_close(torch.func.vmap(layer)(stack), torch.stack([layer(i) for i in stack]))

    def loss(x: torch.Tensor) -> torch.Tensor:
        return layer(x).square().sum()

    want = torch.autograd.grad(loss(x.requires_grad_()), x)[0]
    gradient = torch.func.grad(loss)(x.detach())
    torch.testing.assert_close(gradient, want)
    direction = torch.randn(x.shape, dtype=x.dtype, generator=torch.Generator().manual_seed(0))
    _, slope = torch.func.jvp(loss, (x.detach(),), (direction,))
    torch.testing.assert_close(slope, (want * direction).sum())
