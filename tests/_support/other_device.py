"""A device that computes on the CPU, but whose tensors do not mix with those of the CPU: what a
GPU refuses, it refuses too."""

from contextlib import contextmanager

import torch
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

backend_registration._setup_privateuseone_for_python_backend("elsewhere")
DEVICE = torch.device("elsewhere", 0)
aten = torch.ops.aten
# functions that take tensors of both devices: copies, and indices of the CPU
MIXED = (aten._to_copy, aten.copy_, aten.index, aten.index_put_, aten.index_put)


class _Elsewhere(torch.Tensor):
    """A tensor of the other device, and the one of the CPU that holds its values."""

    @staticmethod
    def __new__(cls, inner):
        return torch.Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), dtype=inner.dtype, device=DEVICE
        )

    def __init__(self, inner):
        self.inner = inner

    __torch_function__ = torch._C._disabled_torch_function_impl

    def __repr__(self):
        return f"_Elsewhere({self.inner})"

    def tolist(self):
        return self.inner.tolist()

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _computed(function, args, kwargs or {})


class _OtherDevice(TorchDispatchMode):
    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return _computed(function, args, kwargs or {})


def _computed(function, args, kwargs):
    given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    elsewhere = [x for x in given if isinstance(x, _Elsewhere)]
    here = [x for x in given if not isinstance(x, _Elsewhere) and x.ndim]
    device = kwargs.get("device")
    if elsewhere and here and function.overloadpacket not in MIXED:
        raise AssertionError(f"{function}: tensors of two devices")
    indexed = function.overloadpacket in (aten.index, aten.index_put_, aten.index_put)
    if indexed and elsewhere and not isinstance(args[0], _Elsewhere):
        raise AssertionError(f"{function}: an index of another device")
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    is_elsewhere = bool(elsewhere) if device is None else torch.device(device).type == DEVICE.type
    if function.overloadpacket == aten.copy_:
        is_elsewhere = isinstance(args[0], _Elsewhere)
    known = {id(x.inner): x for x in elsewhere}

    def unwrapped(x):
        return x.inner if isinstance(x, _Elsewhere) else x

    def wrapped(x):
        if not isinstance(x, torch.Tensor) or not is_elsewhere:
            return x
        return known.get(id(x)) if id(x) in known else _Elsewhere(x)

    result = function(*tree_map(unwrapped, args), **tree_map(unwrapped, kwargs))
    return tree_map(wrapped, result)


@contextmanager
def other_device():
    """Within, ``DEVICE`` exists."""
    before = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor copies to the device by dispatch
    try:
        with _OtherDevice():
            yield DEVICE
    finally:
        torch._C._set_only_lift_cpu_tensors(before)
