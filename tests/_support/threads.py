"""Torch on one thread, for packages of tests on small images."""

from collections.abc import Iterator

import pytest
import torch

__all__ = ["one_thread"]


@pytest.fixture(autouse=True, scope="package")
def one_thread() -> Iterator[None]:
    """Images of a few hundred pixels are slower on several threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
