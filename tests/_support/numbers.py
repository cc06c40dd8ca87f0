"""Numbers in double precision, and generators of random ones."""

import torch


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def eye(n):
    return torch.eye(n, dtype=torch.float64)


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def uniform(*shape, seed=0):
    """Random numbers in [0, 1)."""
    return torch.rand(*shape, generator=seeded(seed), dtype=torch.float64)
