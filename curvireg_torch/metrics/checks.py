"""Checks and reductions that the metrics share."""

import torch
from torch import Tensor

from ..errors import InvalidInputError
from ..utils.checks import check_same_device, check_tensor


def check_errors(errors: Tensor, name: str = "errors") -> None:
    """``errors`` is a floating (N,) tensor of numbers >= 0, ``inf`` included, NaN excluded."""
    check_tensor(errors, name, (None,))
    bad = int((~(errors >= 0)).sum())
    if bad:
        raise InvalidInputError(
            f"{name}: expected numbers >= 0, got {bad} that are negative or NaN; a missing estimate counts as inf"
        )


def inf_unless(valid: Tensor, errors: Tensor) -> Tensor:
    """``errors``, replaced by ``inf`` where ``valid`` is False."""
    return torch.where(valid, errors, torch.full_like(errors, torch.inf))


def fraction_true(hits: Tensor) -> float:
    """Fraction of True in a boolean tensor; NaN if it is empty."""
    return float(hits.double().mean())


def per_item(value: Tensor | float, errors: Tensor, name: str) -> Tensor:
    """``value``, a number or an (N,) tensor of numbers > 0, as a tensor that divides ``errors`` (N,)."""
    if not isinstance(value, Tensor):
        value = torch.as_tensor(value, dtype=errors.dtype, device=errors.device)
    check_same_device(value, errors, name)
    if value.shape not in ((), errors.shape):
        raise InvalidInputError(f"{name}: expected a number or shape {tuple(errors.shape)}, got {tuple(value.shape)}")
    if not bool(((value > 0) & value.isfinite()).all()):
        raise InvalidInputError(f"{name}: expected finite numbers > 0, got {value.tolist()}")
    return value.to(errors.dtype)
