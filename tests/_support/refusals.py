"""Inputs that are refused."""

import pytest

from curvireg_torch.errors import InvalidInputError


def refused(words, error=InvalidInputError):
    """Expect that the input is refused in these words."""
    return pytest.raises(error, match=words)
