"""Numbers in double precision, and generators of random ones."""

import pytest
import torch


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def eye(n):
    return torch.eye(n, dtype=torch.float64)


def zeros(*shape):
    return torch.zeros(shape, dtype=torch.float64)


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def uniform(*shape, seed=0):
    """Random numbers in [0, 1)."""
    return torch.rand(*shape, generator=seeded(seed), dtype=torch.float64)


def skip_unless_products_are_exact():
    """Skip where the CPU's library rounds even products of batches by the place in the batch."""
    a = torch.randn(5, 96, 8, generator=seeded(1))
    b = torch.randn(5, 1, 8, generator=seeded(2))
    for left, right in ((a.mT, a), (b, a.mT)):
        together = torch.bmm(left, right)
        for n in range(5):
            if not torch.bmm(left[n : n + 1], right[n : n + 1])[0].equal(together[n]):
                pytest.skip("products of this CPU are rounded by their place in the batch")
