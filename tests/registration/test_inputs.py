"""What a crop must show to be registered."""

import pytest
import torch

from curvireg_torch.errors import ImageError
from curvireg_torch.registration.inputs import check_crop


def crop(low: float, high: float) -> torch.Tensor:
    values = torch.full((3, 8, 8), low)
    values[:, 2:5, 3] = high
    return values


def test_two_grey_levels_apart_is_something_to_see():
    check_crop(crop(0.4, 0.4 + 2.0 / 255.0))
    with pytest.raises(ImageError, match="one colour"):
        check_crop(crop(0.4, 0.4 + 0.9 / 255.0))


@pytest.mark.parametrize(("low", "high"), [(0.2, 1.01), (-0.01, 0.8)])
def test_pixels_a_little_outside_of_the_range_are_refused(low, high):
    with pytest.raises(ImageError, match=r"outside \[0, 1\]"):
        check_crop(crop(low, high))
    check_crop(crop(0.02 * low, 0.99 * high))
    check_crop(crop(-0.0005, 1.0005))  # what resampling adds
