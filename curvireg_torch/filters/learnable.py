"""Options that a module can learn: positive numbers, kept as their logarithms."""

import math

import torch
from torch import Tensor, nn

from ..utils.checks import check_positive, check_tensor
from .numerics import readable

__all__ = ["as_number", "check_width", "inverse", "keep_positive", "positive_option"]


def keep_positive(module: nn.Module, learnable: bool, **options: float) -> None:
    """Each option as it is, or as a scalar parameter ``log_<name>``, whose exponential stays positive at any step."""
    for name, value in options.items():
        if learnable:
            value = check_positive(value, name)
            module.register_parameter(f"log_{name}", nn.Parameter(torch.tensor(math.log(value))))
        else:
            setattr(module, f"_{name}", value)


def positive_option(name: str) -> property:
    """What :func:`keep_positive` kept: the number, or the exponential of the parameter."""

    def value(module: nn.Module) -> float | Tensor:
        log = module._parameters.get(f"log_{name}")
        kept: float | Tensor = getattr(module, f"_{name}") if log is None else log.exp()
        return kept

    return property(value)


def check_width(value: float | Tensor, name: str, *, zero_ok: bool = False) -> float | Tensor:
    """A number as :func:`check_positive` wants and returns it, or a scalar tensor, checked where it can be read."""
    if not isinstance(value, Tensor):
        return check_positive(value, name, zero_ok=zero_ok)
    check_tensor(value, name, ())
    if readable(value):
        check_positive(float(value.detach()), name, zero_ok=zero_ok)
    return value


def inverse(value: float | Tensor) -> float | Tensor:
    """1 / value; a tensor counts as between 1e-6 and 1e6, so that a graph, which cannot check, makes no infinity."""
    return 1.0 / (value.clamp(min=1e-6, max=1e6) if isinstance(value, Tensor) else value)


def as_number(value: float | Tensor) -> float:
    """The number to show in a module's repr."""
    return round(float(value.detach()), 6) if isinstance(value, Tensor) else value
