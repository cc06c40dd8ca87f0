"""Non-maximum suppression: which two neighbours a pixel is compared with."""

import pytest
import torch

from curvireg_torch.filters.suppression import is_directional_maximum


@pytest.mark.parametrize("across", [0.0, 22.0, 23.0, 45.0, 67.0, 68.0, 90.0, 112.0, 113.0, 135.0, 157.0, 158.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_directions_are_rounded_to_the_nearest_45_degrees(across: float, sign: float) -> None:
    """A pixel longer than the two neighbours on its rounded axis is a ridge, however long the other six are."""
    axis = [(1, 0), (1, 1), (0, 1), (-1, 1)][round(across / 45.0) % 4]
    length = torch.full((1, 1, 3, 3), 2.0)
    length[..., 1, 1] = 1.0
    angle = torch.deg2rad(torch.tensor(across))
    x, y = (sign * f(angle).expand(1, 1, 3, 3) for f in (torch.cos, torch.sin))
    assert not bool(is_directional_maximum(length, x, y)[0, 0, 1, 1])
    for side in (1, -1):
        length[..., 1 + side * axis[1], 1 + side * axis[0]] = 0.5
    assert bool(is_directional_maximum(length, x, y)[0, 0, 1, 1])
