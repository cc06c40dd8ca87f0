"""Options that a module can learn."""

import torch
from torch import nn


def parameter_if(learnable: bool, value: float) -> float | nn.Parameter:
    """``value`` as it is, or as a scalar parameter.

    A learnable sigma keeps the support that it has at each call; it is an error for it to leave (0, inf).
    """
    return nn.Parameter(torch.tensor(float(value))) if learnable else value


def as_number(value: float | nn.Parameter) -> float:
    """The number to show in a module's repr."""
    return round(float(value.detach()), 6) if isinstance(value, nn.Parameter) else value
