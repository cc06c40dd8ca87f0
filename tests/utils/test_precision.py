import pytest
import torch

from curvireg_torch.utils.precision import exact_convolutions, full_precision
from curvireg_torch.utils.threads import map_on_threads


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_is_off_within_and_as_before_afterwards(dtype):
    a = torch.rand(3, 3)

    @full_precision()
    def product(x, *, y):
        """Of matrices."""
        return x @ y

    with torch.autocast("cpu", dtype=dtype):
        assert (a @ a).dtype == dtype
        assert product(a, y=a).dtype == torch.float32
        with full_precision():
            assert (a @ a).dtype == torch.float32
        with pytest.raises(RuntimeError):
            product(a, y=torch.rand(2, 2))
        assert (a @ a).dtype == dtype
    assert product.__doc__ == "Of matrices."


@pytest.mark.parametrize("count", [1, 2])
def test_jobs_compute_without_autocast_on_one_thread_and_on_several(threads, count):
    threads(count)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        dtypes = map_on_threads(lambda _: (torch.eye(2) @ torch.eye(2)).dtype, range(3))
    assert dtypes == [torch.float32] * 3


@pytest.mark.skipif(not hasattr(torch.backends.cudnn, "conv"), reason="this torch has one flag")
@pytest.mark.parametrize(
    ("holder", "name", "chosen", "default"),
    [
        (torch.backends, "fp32_precision", "ieee", "none"),
        (torch.backends, "fp32_precision", "tf32", "none"),
        (torch.backends.cudnn, "allow_tf32", False, True),
        (torch.backends.cudnn, "allow_tf32", True, True),
    ],
)
def test_convolutions_are_exact_however_torch_was_set(holder, name, chosen, default):
    def compute_and_fail():
        with exact_convolutions(), exact_convolutions():
            assert torch.backends.cudnn.conv.fp32_precision != "tf32"
            raise ValueError("within")

    setattr(holder, name, chosen)
    try:
        before = torch.backends.cudnn.conv.fp32_precision
        with pytest.raises(ValueError, match="within"):
            compute_and_fail()
        assert torch.backends.cudnn.conv.fp32_precision == before
        assert getattr(holder, name) == chosen
    finally:
        setattr(holder, name, default)
