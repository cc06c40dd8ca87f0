"""The contract of every layer, as one base class of tests: a test module defines ``cases`` and
inherits the tests; it disables one that does not apply with ``test_gradcheck = None``."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from curvireg_torch.errors import InvalidInputError
from tests._support.numbers import double, seeded, uniform

SIZE = 24


@dataclass(frozen=True)
class LayerCase:
    """A function with its options, its module twin if it has one, and a generator of inputs."""

    name: str
    function: Callable[..., Any]
    inputs: Callable[..., Tensor]
    """inputs(n, size, seed=, dtype=) -> (n, C, size, size)."""
    module: Callable[..., nn.Module] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    gradcheck_options: Mapping[str, Any] = field(default_factory=dict)
    constant_gives_zero: bool = True
    min_size: int = 1
    accepts_colour: bool = True
    is_variant: bool = False
    """Another option of a case before: its tests are slow ones."""

    def __call__(self, x):
        return self.function(x, **self.options)

    def twin(self):
        """The module with the same options; without one, the function is a module."""
        return self.function if self.module is None else self.module(**self.options)


def tensors(output):
    """The tensors of an output: itself, or those of a tuple."""
    return (output,) if isinstance(output, Tensor) else tuple(output)


def degenerate_images():
    x = torch.arange(16.0)
    bright = torch.zeros(1, 1, 16, 16)
    bright[..., 8, 8] = 1.0
    return {
        "zeros": torch.zeros(1, 1, 16, 16),
        "constant": torch.full((1, 1, 16, 16), 0.7),
        "one pixel": torch.full((1, 1, 1, 1), 0.5),
        "one bright pixel": bright,
        "checkerboard": ((x[:, None] + x) % 2)[None, None],
        "saturated": torch.rand(1, 1, 16, 16, generator=seeded(1)).mul(3.0).clamp(max=1.0),
        "two levels": (x >= 8).float().expand(1, 1, 16, 16).contiguous(),
        "row": torch.rand(1, 1, 1, 16, generator=seeded(0)),
    }


class LayerContract:
    """Tests that every layer has to pass; see the module for its use."""

    cases: ClassVar[Sequence[LayerCase]] = ()
    batch_tolerance: ClassVar[Mapping[str, float]] = {"rtol": 1e-6, "atol": 1e-9}

    def pytest_generate_tests(self, metafunc):
        if "case" in metafunc.fixturenames:
            marks = {False: (), True: pytest.mark.slow}
            cases = [pytest.param(c, id=c.name, marks=marks[c.is_variant]) for c in self.cases]
            metafunc.parametrize("case", cases)

    def agrees(self, got, want):
        """Equality of compiled results: another order of summation flips single pixels at a
        threshold or a sign."""
        for a, b in zip(tensors(got), tensors(want), strict=True):
            a = a.detach()
            b = b.detach()
            error = (a.float() - b.float()).abs()
            if b.ndim == 4 and b.shape[1] == 2:
                error = torch.minimum(error, (a + b).abs()).amax(dim=1)
            differs = error > 1e-3 * float(b.abs().max())
            if a.shape != b.shape or float(differs.float().mean()) >= 0.005:
                return False
        return True

    def test_function_equals_module(self, case):
        x = case.inputs(2, SIZE)
        before = x.clone()
        want = case(x)
        twin = case.twin()
        assert_close(tensors(twin(x)), tensors(want), rtol=0.0, atol=0.0)
        assert torch.equal(x, before)
        assert type(twin).__name__ in repr(twin)
        for y in tensors(want):
            assert (y.device, len(y)) == (x.device, len(x))
            assert torch.isfinite(y).all()

    def test_batched_equals_one_by_one(self, case):
        """The images differ in contrast and depth range, so that a normalisation over the batch is
        detected."""
        scale = double([1.0, 0.1, 0.0]).view(-1, 1, 1, 1)
        x = case.inputs(3, SIZE, dtype=torch.float64) * scale
        together = tensors(case(x))
        for i in range(3):
            alone = tensors(case(x[[i]]))
            assert_close([t[[i]] for t in together], [*alone], **self.batch_tolerance)

    def test_empty_batch(self, case):
        x = case.inputs(2, SIZE)
        for empty, full in zip(tensors(case(x[:0])), tensors(case(x)), strict=True):
            assert empty.shape == (0, *full.shape[1:])

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
    def test_dtype_is_kept(self, case, dtype):
        x = case.inputs(2, SIZE).to(dtype)
        y = case(x)
        assert {t.dtype for t in tensors(y)} == {dtype}
        if dtype is not torch.float64:  # half types compute in float32
            want = tuple(t.to(dtype) for t in tensors(case(x.float())))
            assert_close(tensors(y), want, rtol=0.0, atol=0.0)

    @pytest.mark.parametrize("image", list(degenerate_images()))
    def test_finite_on_degenerate_input(self, case, image):
        x = degenerate_images()[image]
        if min(x.shape[-2:]) < case.min_size:
            return
        x = x.repeat(1, case.inputs(1, SIZE).shape[1], 1, 1).requires_grad_()
        y = tensors(case(x))
        assert all(torch.isfinite(t).all() for t in y)
        sum(t.square().sum() + t.sum() for t in y).backward()
        assert x.grad is not None
        assert torch.isfinite(x.grad).all()
        if case.constant_gives_zero and image in ("zeros", "constant") and x.shape[1] == 1:
            assert all(float(t.detach().float().abs().max()) < 1e-6 for t in y)

    def test_gradcheck(self, case):
        """At generic points, where no maximum, threshold or suppression switches within the
        step."""
        x = case.inputs(1, 9, seed=3, dtype=torch.float64)
        x = 0.95 * x + 0.05 * uniform(*x.shape) * (x > 0)  # in the range of images
        # Pixels of 0 may be background of a depth image, which a step would make visible.
        index = (x != 0).nonzero(as_tuple=True)
        weights = self.gradcheck_weights(case, x)

        options = {**case.options, **case.gradcheck_options}

        def function(values):
            return case.function(x.index_put(index, values), **options) * weights

        assert function(x[index]).abs().max() > 0.0
        values = x[index].requires_grad_()
        tolerance = {"eps": 1e-7, "atol": 1e-5, "rtol": 1e-4}
        assert torch.autograd.gradcheck(function, values, **tolerance, fast_mode=True)

    def gradcheck_weights(self, case, x):
        """Factor on the output that excludes pixels where it is not differentiable."""
        return 1.0

    @pytest.mark.filterwarnings("ignore:There is a performance drop")
    @pytest.mark.parametrize("block", [None, SIZE**2])
    def test_function_transforms(self, case, block, monkeypatch):
        """vmap, reverse and forward derivatives; also of batches that are processed in blocks."""
        x = case.inputs(2, SIZE, dtype=torch.float64)
        halved = case(0.5 * x)

        def loss(x):
            return case(x).square().sum()

        want = torch.autograd.grad(loss(x.requires_grad_()), x)[0]
        y = case(x).detach()
        x = x.detach()
        direction = torch.randn(x.shape, dtype=x.dtype, generator=seeded(0))
        if block is not None:
            monkeypatch.setattr("curvireg_torch.filters.operations.BLOCK_PIXELS", block)
        assert_close(torch.func.vmap(case)(torch.stack([x, 0.5 * x])), torch.stack([y, halved]))
        assert_close(torch.func.grad(loss)(x), want)
        _, slope = torch.func.jvp(loss, (x,), (direction,))
        assert_close(slope, (want * direction).sum())
        with torch.autograd.forward_ad.dual_level():
            dual = loss(torch.autograd.forward_ad.make_dual(x, direction))
            assert_close(torch.autograd.forward_ad.unpack_dual(dual).tangent, slope)

    def test_bad_input_is_rejected(self, case):
        x = case.inputs(1, SIZE)
        wrong = [
            (x[0], "expected shape"),
            (x.byte(), r"expected a floating dtype, got torch\.uint8"),
            (x[..., :0], "at least"),
            (x.to_sparse(), "expected a dense tensor"),
            (x.to(torch.float8_e5m2), "that is not float8"),
        ]
        if case.accepts_colour:
            wrong.append((x.repeat(1, 4, 1, 1), "got"))
        for bad, message in wrong:
            with pytest.raises(InvalidInputError, match=message):
                case(bad)

    @pytest.mark.slow
    @pytest.mark.parametrize("dynamic", [False, True])
    def test_compile_fullgraph(self, case, dynamic):
        """Compiled by inductor for one size, and traced as one graph for any size."""
        torch._dynamo.reset()
        options = {"dynamic": True, "backend": "aot_eager"} if dynamic else {}
        graph = torch.compile(case.twin(), fullgraph=True, **options)
        for n, size in ((2, SIZE), (3, SIZE + 6)) if dynamic else ((2, SIZE),):
            x = case.inputs(n, size)
            assert self.agrees(graph(x), case(x))

    @pytest.mark.slow
    def test_export_with_any_batch(self, case):
        batch = torch.export.Dim("batch", min=1, max=64)
        program = torch.export.export(
            case.twin(), (case.inputs(3, SIZE),), dynamic_shapes=({0: batch},)
        )
        for n in (2, 5):
            x = case.inputs(n, SIZE, seed=7)
            assert self.agrees(program.module()(x), case(x))
