import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from curvireg_torch import features
from curvireg_torch.features import field_points, hog
from curvireg_torch.filters import ImageGradient, image_gradient
from tests._support import refused, seeded

from ..filters.layer_cases import grid, photos


def _slow_hog(field, grid, bins, block, clip):
    """Linear voting pixel by pixel."""
    _, H, W = field.shape
    cells = np.zeros((grid, grid, bins))
    for i in range(H):
        for j in range(W):
            length = math.hypot(*field[:, i, j])
            position = (math.atan2(field[1, i, j], field[0, i, j]) % math.pi) * bins / math.pi - 0.5
            row = (i + 0.5) * grid / H - 0.5
            column = (j + 0.5) * grid / W - 0.5
            for r in (math.floor(row), math.floor(row) + 1):
                for c in (math.floor(column), math.floor(column) + 1):
                    for b in (math.floor(position), math.floor(position) + 1):
                        if 0 <= r < grid and 0 <= c < grid:
                            weight = (
                                (1 - abs(row - r)) * (1 - abs(column - c)) * (1 - abs(position - b))
                            )
                            cells[r, c, b % bins] += length * weight * grid**2 / (H * W)
    out = []
    for r in range(grid - block + 1):
        for c in range(grid - block + 1):
            v = cells[r : r + block, c : c + block].ravel()
            v = np.minimum(v / math.sqrt((v**2).sum() + 1e-10), clip)
            out.append(v / math.sqrt((v**2).sum() + 1e-10))
    return np.concatenate(out)


@pytest.mark.parametrize(("shape", "grid"), [((24, 24), 4), ((21, 30), 4)])
def test_hog_with_linear_voting_against_loops(shape, grid):
    field = torch.randn(1, 2, *shape, generator=seeded(0), dtype=torch.float64)
    want = _slow_hog(field[0].numpy(), grid, 9, 2, 0.2)
    np.testing.assert_allclose(hog(field, grid=grid)[0], want, atol=1e-10)


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_hog_is_invariant_to_sign_and_contrast(factor, dtype):
    generator = seeded(0)
    field = torch.randn(2, 2, 32, 32, generator=generator, dtype=dtype)
    signs = torch.where(torch.rand(2, 1, 32, 32, generator=generator) < 0.5, -1.0, 1.0)
    field[:, :, 16:] *= 0.01  # weak blocks as well as strong ones
    assert_close(hog(factor * signs * field), hog(field), rtol=1e-4, atol=1e-6)
    assert not hog(torch.zeros_like(field)).any()


def test_hog_suppresses_blocks_far_below_the_strongest():
    field = torch.zeros(1, 2, 64, 64, dtype=torch.float64)
    field[:, 0, :32] = 1.0
    field[:, 1, 32:] = 1e-13  # rounding
    lengths = hog(field).view(7, 7, 36).norm(dim=-1)
    assert lengths[:3].min() > 0.99
    assert lengths[5:].max() < 0.01


def test_hog_bin_weights_scale_votes_and_stay_positive_when_learnt():
    field = torch.randn(2, 2, 32, 32, generator=seeded(1))
    without = hog(field, bin_weights=torch.tensor([0.0, *[1.0] * 8]))
    assert without.view(2, -1, 9)[..., 0].abs().max() == 0.0
    module = features.HOG(learnable=True)
    assert_close(module(field), hog(field))
    assert features.HOG().state_dict() == {}
    optimizer = torch.optim.SGD(module.parameters(), lr=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        module(field)[:, ::9].sum().backward()
        optimizer.step()
    weights = module.bin_weights.detach()
    assert 0.0 < weights[0] < 0.1  # a step of the weights themselves leads to -2.5
    assert weights.min() > 0.0


def test_hog_rejects_wrong_weights_and_grids():
    for options, message in (
        *(
            ({"bin_weights": torch.tensor([w, *[1.0] * 8])}, "expected factors >= 0")
            for w in (-1e-3, math.nan)
        ),
        ({"bin_weights": torch.ones(8)}, r"bin_weights: expected shape \(9\)"),
        ({"grid": 32}, "at least 32 x 32 px"),
    ):
        with refused(message):
            hog(torch.zeros(1, 2, 16, 16), **options)


def _line(angle):
    """A ridge through the centre of a 41 px image, the field pointing across it."""
    x, y = grid(41, dtype=torch.float32)
    a = torch.tensor(angle).deg2rad()
    distance = x * torch.cos(a) + y * torch.sin(a)
    return torch.exp(-0.5 * (distance / 2) ** 2)[None] * torch.stack(
        [torch.cos(a), torch.sin(a)]
    ).view(2, 1, 1)


@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 70.0, 90.0, 135.0, 160.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_field_points_of_a_ridge_are_a_thin_line(angle, sign):
    field = sign * _line(angle)[None]
    points = (field_points(field, fraction=1.0) & (field.norm(dim=1, keepdim=True) > 0.5))[0, 0]
    y, x = (points.nonzero().T - 20).float()
    a = torch.tensor(angle).deg2rad()
    assert (x * torch.cos(a) + y * torch.sin(a)).abs().max() <= 0.75
    longest = 41 if angle in (0.0, 90.0, 45.0, 135.0) else 35
    assert longest - 6 <= len(x) <= 81  # a diagonal is a staircase


@settings(max_examples=10, deadline=None, derandomize=True)
@given(seed=st.integers(0, 1000), fraction=st.floats(0.01, 0.3))
def test_field_points_fraction_selects_the_longest_of_each_image(seed, fraction):
    field = image_gradient(photos(3, 24, seed=seed, dtype=torch.float64))
    field = field * torch.tensor([1.0, 0.01, 5.0]).view(3, 1, 1, 1)
    points = field_points(field, fraction=fraction)
    every = field_points(field, fraction=1.0)
    length = field.norm(dim=1, keepdim=True)
    for p, e, v in zip(points, every, length, strict=True):
        assert int(p.sum()) == min(max(1, int(fraction * 576)), int(e.sum()))
        assert (p <= e).all()
        if bool((e & ~p).any()):
            assert v[p].min() >= v[e & ~p].max()


def test_field_points_of_a_ridge_two_pixels_wide_are_one_pixel_wide():
    field = torch.zeros(1, 2, 5, 8)
    field[0, 0, :, 2:6] = torch.tensor([1.0, 2.0, 2.0, 1.0])
    assert field_points(field, fraction=1.0)[0, 0].sum(dim=1).tolist() == [1] * 5


@pytest.mark.parametrize("learnable", [False, True])
def test_hog_on_the_meta_device(learnable):
    layer = features.HOG(grid=4, learnable=learnable).to("meta")
    assert repr(layer).endswith(f"bin_weights={'<(9,)>' if learnable else None})")
    assert "sigma=<()>" in repr(ImageGradient(learnable=True).to("meta"))
    descriptors = layer(torch.zeros(3, 2, 40, 48, device="meta"))
    assert (descriptors.device.type, descriptors.shape) == ("meta", (3, layer.length))


@pytest.mark.parametrize(("bins", "learnable"), [(9, False), (8, True), (1, False)])
def test_descriptor_of_a_quarter_turn_is_that_of_the_rotated_field(bins, learnable):
    generator = seeded(0)
    field = torch.randn(3, 2, 40, 40, generator=generator, dtype=torch.float64)
    field[1, 0, 3, 4] = math.nan
    layer = features.HOG(grid=4, bins=bins, learnable=learnable)
    if learnable:
        layer.bin_weights = torch.linspace(0.5, 2.0, bins)
    rotated = torch.stack([-field[:, 1], field[:, 0]], dim=1).rot90(-1, (2, 3))
    for found, expected in zip(
        layer.with_quarter_turn(field), (layer(field), layer(rotated)), strict=True
    ):
        assert_close(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("bins", [9, 8, 1])
def test_descriptor_in_a_mirror_is_that_of_the_flipped_field(bins):
    field = torch.randn(3, 2, 40, 44, generator=seeded(1), dtype=torch.float64)
    layer = features.HOG(grid=5, bins=bins)
    flipped = torch.stack([-field[:, 0], field[:, 1]], dim=1).flip(-1)
    assert_close(layer.mirrored(layer(field)), layer(flipped), rtol=0, atol=1e-9)
