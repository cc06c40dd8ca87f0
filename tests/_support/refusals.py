"""Inputs that are refused."""

import pytest

from curvireg_torch.errors import InvalidInputError


def refused(words):
    """Expect that the input is refused in these words."""
    return pytest.raises(InvalidInputError, match=words)
