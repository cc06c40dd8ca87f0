"""Options that a module can learn, and the base class of the modules that mirror a function."""

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from ..errors import InvalidInputError
from ..utils.checks import check_positive, check_tensor
from .numerics import is_host_readable


class Positive(nn.Module):
    """Parametrization of a positive parameter by its logarithm, so that any optimiser step keeps it positive."""

    def forward(self, log: Tensor) -> Tensor:
        return log.exp()

    def right_inverse(self, value: Tensor) -> Tensor:
        return value.log()


class OptionsModule(nn.Module):
    """Module twin of a function: it holds all options of the function, in the order in which ``repr`` shows them."""

    LEARNABLE: ClassVar[tuple[str, ...]] = ("sigma",)
    """Options that ``learnable=True`` makes positive parameters."""

    def __init__(self, learnable: bool = False, **options: Any) -> None:
        super().__init__()
        self._names = tuple(options)
        for name, value in options.items():
            if learnable and name in self.LEARNABLE:
                self.register_parameter(name, nn.Parameter(torch.tensor(check_positive(value, name))))
                parametrize.register_parametrization(self, name, Positive())
            else:
                setattr(self, name, value)

    @property
    def options(self) -> dict[str, Any]:
        """The present values, as keyword arguments of the function."""
        return {name: getattr(self, name) for name in self._names}

    def extra_repr(self) -> str:
        numbers = {k: round(float(v.detach()), 6) if isinstance(v, Tensor) else v for k, v in self.options.items()}
        return ", ".join(f"{name}={value!r}" for name, value in numbers.items())


def check_scalar(value: float | Tensor, name: str, *, zero_ok: bool = False) -> float | Tensor:
    """Check a positive option given as a number or as a scalar tensor, whose value is checked where it is readable."""
    if not isinstance(value, Tensor):
        return check_positive(value, name, zero_ok=zero_ok)
    check_tensor(value, name, ())
    if is_host_readable(value):
        check_positive(float(value.detach()), name, zero_ok=zero_ok)
    return value


def check_sigmas(sigmas: Sequence[float], name: str) -> list[float]:
    """At least one standard deviation, each > 0."""
    if len(sigmas) == 0:
        raise InvalidInputError(f"{name}: expected at least one sigma, got none")
    return [check_positive(sigma, name) for sigma in sigmas]


def safe_reciprocal(value: float | Tensor) -> float | Tensor:
    """1 / value; a tensor is clamped to [1e-6, 1e6], because its range cannot be checked while tracing."""
    return 1.0 / (value.clamp(min=1e-6, max=1e6) if isinstance(value, Tensor) else value)
