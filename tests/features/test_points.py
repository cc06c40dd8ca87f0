"""Feature points of a vector field."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.features import field_points
from curvireg_torch.filters import image_gradient

from ..filters.layer_cases import photos


def _line(angle: float) -> torch.Tensor:
    """A ridge through the centre of a 41 px image, the field pointing across it."""
    axis = torch.arange(41.0) - 20
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    a = torch.tensor(angle).deg2rad()
    distance = x * torch.cos(a) + y * torch.sin(a)
    return torch.exp(-0.5 * (distance / 2) ** 2)[None] * torch.stack([torch.cos(a), torch.sin(a)]).view(2, 1, 1)


@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 70.0, 90.0, 135.0, 160.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_field_points_of_a_ridge_are_a_thin_line(angle: float, sign: float) -> None:
    field = sign * _line(angle)[None]
    points = (field_points(field, fraction=1.0) & (field.norm(dim=1, keepdim=True) > 0.5))[0, 0]
    y, x = (points.nonzero().T - 20).float()
    a = torch.tensor(angle).deg2rad()
    assert float((x * torch.cos(a) + y * torch.sin(a)).abs().max()) <= 0.75
    longest = 41 if angle in (0.0, 90.0, 45.0, 135.0) else 35
    assert longest - 6 <= len(x) <= 81  # a diagonal is a staircase


@settings(max_examples=10, deadline=None, derandomize=True)
@given(seed=st.integers(0, 1000), fraction=st.floats(0.01, 0.3))
def test_field_points_fraction_selects_the_longest_of_each_image(seed: int, fraction: float) -> None:
    field = image_gradient(photos(3, 24, seed=seed, dtype=torch.float64))
    field = field * torch.tensor([1.0, 0.01, 5.0]).view(3, 1, 1, 1)
    points = field_points(field, fraction=fraction)
    every = field_points(field, fraction=1.0)
    length = field.norm(dim=1, keepdim=True)
    for p, e, v in zip(points, every, length, strict=True):
        assert int(p.sum()) == min(max(1, int(fraction * 576)), int(e.sum()))
        assert bool((p <= e).all())
        if bool((e & ~p).any()):
            assert float(v[p].min()) >= float(v[e & ~p].max())


def test_field_points_of_zero_fields_and_bad_input() -> None:
    assert not field_points(torch.zeros(2, 2, 8, 8)).any()
    assert field_points(torch.zeros(0, 2, 8, 8)).shape == (0, 1, 8, 8)
    with pytest.raises(InvalidInputError, match="fraction"):
        field_points(torch.zeros(1, 2, 8, 8), fraction=0.0)


def test_field_points_of_a_fraction_below_one_pixel() -> None:
    field = torch.zeros(1, 2, 1, 9)
    field[0, 0, 0, [1, 4, 7]] = torch.tensor([1.0, 3.0, 2.0])
    assert field_points(field, fraction=1e-3)[0, 0, 0].nonzero().flatten().tolist() == [4]
    assert int(field_points(field, fraction=2 / 9).sum()) == 2
