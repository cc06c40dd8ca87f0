"""Numbers in double precision."""

import torch


def double(values):
    return torch.tensor(values, dtype=torch.float64)
