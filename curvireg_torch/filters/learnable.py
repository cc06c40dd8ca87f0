"""Options that a module can learn, and the base class of the modules that mirror a function."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from ..utils.checks import check_positive, check_tensor
from .numerics import is_host_readable

__all__ = ["OptionsModule", "Positive", "check_scalar", "safe_reciprocal"]


class Positive(nn.Module):
    """Parametrization of a positive parameter by its logarithm, so that any optimiser step keeps it positive."""

    def forward(self, log: Tensor) -> Tensor:
        return log.exp()

    def right_inverse(self, value: Tensor) -> Tensor:
        return value.log()


class OptionsModule(nn.Module):
    """Module twin of a function: it holds the function's options, learnable ones as positive parameters.

    Args:
        learnable: names of the options that become parameters; their values must be positive.
        options: all options of the function by name, in the order in which ``repr`` shows them.
    """

    def __init__(self, *, learnable: Sequence[str] = (), **options: Any) -> None:
        super().__init__()
        self._names = tuple(options)
        for name, value in options.items():
            if name in learnable:
                self.register_parameter(name, nn.Parameter(torch.tensor(check_positive(value, name))))
                parametrize.register_parametrization(self, name, Positive())
            else:
                setattr(self, name, value)

    @property
    def options(self) -> dict[str, Any]:
        """The options with their present values, as keyword arguments of the function."""
        return {name: getattr(self, name) for name in self._names}

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={_plain(value)!r}" for name, value in self.options.items())


def _plain(value: object) -> object:
    return round(float(value.detach()), 6) if isinstance(value, Tensor) else value


def check_scalar(value: float | Tensor, name: str, *, zero_ok: bool = False) -> float | Tensor:
    """Check a positive option given as a number or as a scalar tensor, whose value is checked where it is readable."""
    if not isinstance(value, Tensor):
        return check_positive(value, name, zero_ok=zero_ok)
    check_tensor(value, name, ())
    if is_host_readable(value):
        check_positive(float(value.detach()), name, zero_ok=zero_ok)
    return value


def safe_reciprocal(value: float | Tensor) -> float | Tensor:
    """1 / value; a tensor is clamped to [1e-6, 1e6], because its range cannot be checked while tracing."""
    return 1.0 / (value.clamp(min=1e-6, max=1e6) if isinstance(value, Tensor) else value)
