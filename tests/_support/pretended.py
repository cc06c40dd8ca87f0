"""A device that pretends to be a GPU: values are computed on the CPU, and what a GPU would refuse is refused."""

import functools
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

__all__ = ["PRETENDING", "Pretended", "pretended_gpu"]

PRETENDING = [
    pytest.mark.skipif(torch.cuda.is_available(), reason="there is a real device"),
]
"""Marks of tests that need the pretended device; :func:`pretended_gpu` skips them where torch cannot pretend one."""

CROSSING = {"copy_", "_to_copy"}
"""Operators that take tensors from one device to another."""

INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_"}
"""Operators whose indices may be on the CPU."""


class Pretended(Tensor):
    """A tensor on the device, and where it is in truth, ``inner``."""

    inner: Tensor
    on: ClassVar[torch.device]

    @staticmethod
    def __new__(cls, inner: Tensor) -> "Pretended":
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=cls.on,
        )
        made.inner = inner
        return made

    def tolist(self) -> Any:
        return self.inner.tolist()

    def item(self) -> Any:
        return self.inner.item()

    def __bool__(self) -> bool:
        return bool(self.inner)

    def __float__(self) -> float:
        return float(self.inner)

    def __int__(self) -> int:
        return int(self.inner)

    def __index__(self) -> int:
        return self.inner.__index__()

    def numpy(self, **_: Any) -> Any:  # type: ignore[override]
        raise TypeError("can't convert a tensor on the device to numpy; use Tensor.cpu() first")

    @classmethod
    def __torch_dispatch__(cls, func: Any, _: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


class _Factories(TorchDispatchMode):
    """Tensors that are made on the device, or moved there."""

    def __torch_dispatch__(self, func: Any, _: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


def computed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    given = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
    there = [x for x in given if isinstance(x, Pretended)]
    here = [x for x in given if not isinstance(x, Pretended) and x.ndim > 0]
    name = func.overloadpacket.__name__
    if name in INDEXING and here:
        here = [x for x in here if x is args[0] or (len(args) > 2 and x is args[2])]
    if there and here and name not in CROSSING:
        shapes = [(str(x.device), tuple(x.shape)) for x in given]
        raise RuntimeError(f"{func}: expected all tensors on one device, got {shapes}")
    device = kwargs.get("device")
    on_device = bool(there) if device is None else torch.device(device).type == Pretended.on.type
    if name == "copy_":
        on_device = isinstance(args[0], Pretended)
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    owners = {id(x.inner): x for x in there}
    args, kwargs = tree_map(lambda x: x.inner if isinstance(x, Pretended) else x, (args, kwargs))
    out = func(*args, **kwargs)

    def wrapped(x: Any) -> Any:
        if not isinstance(x, Tensor) or not on_device:
            return x
        return owners[id(x)] if id(x) in owners else Pretended(x)

    return tree_map(wrapped, out)


def _python_backend() -> torch.device:
    """torch 2.10 and later, with or without CUDA: a backend written in Python."""
    backend_registration._setup_privateuseone_for_python_backend("pretended")
    return torch.device("pretended", 0)


def _cuda_without_driver() -> torch.device:
    """Before, only torch that is linked with CUDA."""
    torch._C._ensureCUDADeviceGuardSet()
    return torch.device("cuda", 0)


@functools.cache
def _why_not() -> str:
    """Set up the device, once per process; why that cannot be done, or nothing."""
    reasons = []
    for set_up in (_python_backend, _cuda_without_driver):
        try:
            Pretended.on = set_up()
            Pretended(torch.zeros(2))[:1]  # what a device that is not linked refuses
            return ""
        except (AttributeError, RuntimeError) as error:
            reasons.append(str(error).splitlines()[0])
    return "; ".join(reasons)


@contextmanager
def _this_thread() -> Iterator[None]:
    lifted = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(...) makes it on the CPU and moves it
    try:
        with _Factories():
            yield
    finally:
        torch._C._set_only_lift_cpu_tensors(lifted)


@contextmanager
def pretended_gpu() -> Iterator[torch.device]:
    """Within, tensors can be computed on the device that it gives, in pools of threads too.

    Skips the test where this torch cannot pretend a device.
    """
    if reason := _why_not():
        pytest.skip(f"this torch can pretend no device: {reason}")
    submit = ThreadPoolExecutor.submit

    def submitted(pool: ThreadPoolExecutor, job: Any, /, *args: Any, **kwargs: Any) -> Any:
        def on_device() -> Any:
            with _this_thread():
                return job(*args, **kwargs)

        return submit(pool, on_device)

    overwritten = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)  # by tensors of another type
    try:
        with pytest.MonkeyPatch.context() as patch, torch.backends.cudnn.flags(enabled=False), _this_thread():
            patch.setattr(torch.cuda, "_lazy_init", lambda: None)
            patch.setattr(ThreadPoolExecutor, "submit", submitted)
            yield Pretended.on
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(overwritten)
