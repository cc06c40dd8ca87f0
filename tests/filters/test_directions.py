"""Edges, lines and ridges of known blur and strength at 0 to 60 degrees, on which finite
differences depend."""

import math

import pytest
import torch

from curvireg_torch import filters
from curvireg_torch.filters.focus import MODES

from .layer_cases import grid

ANGLES = (0.0, 15.0, 30.0, 45.0, 60.0)
SIZE = 81
MIDDLE = SIZE // 2
in_all_directions = pytest.mark.parametrize("angle", ANGLES)
in_both_modes = pytest.mark.parametrize("mode", MODES)


def direction(angle):
    radians = math.radians(angle)
    return math.cos(radians), math.sin(radians)


def across(angle, offset=0.0):
    """Distance in px of each pixel from a line at ``offset`` px from the middle, whose normal has
    the angle."""
    x, y = grid(SIZE)
    gx, gy = direction(angle)
    return gx * x + gy * y - offset


def edge(angle, blur, *, contrast=1.0, offset=0.0):
    """(1, 1, SIZE, SIZE) step from 0 to ``contrast``, blurred."""
    return (0.5 * contrast * (1.0 + torch.erf(across(angle, offset) / (blur * math.sqrt(2.0)))))[
        None, None
    ]


@in_all_directions
@in_both_modes
@pytest.mark.parametrize("blur", [1.0, 1.5, 2.0, 3.0, 4.0])
def test_edge_blur_in_all_directions(angle, mode, blur):
    estimates = filters.edge_blur(edge(angle, blur), mode=mode)[0, :, MIDDLE, MIDDLE]
    assert estimates.tolist() == pytest.approx([blur] * 4, rel=0.015)
    assert (estimates > 0.999 * blur).all()  # the focus 1/s does not exceed 1/blur


@in_all_directions
@in_both_modes
@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5])
def test_multiscale_focus_curves_keep_their_bound_in_all_directions(angle, mode, offset):
    for blur, sigma in ((1.0, 0.0), (0.7, 1.0), (2.0, 1.0), (1.5, 1.5)):
        image = edge(angle, blur, offset=offset)
        field = filters.multiscale_focus_curves(image, sigma=sigma, mode=mode, saliency_weight=0.0)
        bound = 1.0 / math.hypot(blur, sigma)
        # without the corners, where an edge ends
        largest = float(field[0, :, 20:-20, 20:-20].norm(dim=0).max())
        assert largest < 1.005 * bound
        assert offset > 0.0 or largest > 0.985 * bound  # where a pixel lies on the centre line


def test_multiscale_focus_curves_are_at_most_their_limit_elsewhere():
    noise = torch.rand(2, 1, 40, 40, generator=torch.Generator().manual_seed(0))
    field = filters.multiscale_focus_curves(noise, sigma=0.0, saliency_weight=0.0)
    assert field.norm(dim=1).max() == pytest.approx(1 / 0.6)


def _saliency_peak(image, sigma):
    return math.sqrt(
        float(filters.image_curvilinear_saliency(image, sigma=sigma)[0, :, MIDDLE, MIDDLE].norm())
    )


def test_saliency_of_equal_edges_hardly_depends_on_the_direction():
    """MCS divides by the strongest edge of the image: with sigma 1 the direction changes CS by less
    than a fifth, about (1 + 1/3) / (1 + 1/6), which is little beside its threshold exp(-5)."""
    sharp = [_saliency_peak(edge(angle, 0.4), 1.0) ** 2 for angle in ANGLES]
    assert 1.08 < max(sharp) / min(sharp) < 1.2


@in_all_directions
def test_second_derivatives_across_a_ridge(angle):
    """z = -h exp(-t^2 / 2 w^2) has |z''| = h w / (w^2 + v)^1.5 on its line, where v is the variance
    of smoothing and of the second differences. Differences along the line are not zero on the grid;
    CS subtracts them."""
    height = 0.2
    width = 2.0
    sigma = 1.0
    ridge = (3.0 - height * torch.exp(-0.5 * (across(angle) / width) ** 2))[None, None]
    gx, gy = direction(angle)
    hessian_variance = (gx**6 + gy**6) / 6.0 + (2.0 / 3.0) * (gx * gy) ** 2
    for layer, variance in (
        (filters.hessian_frobenius_norm, hessian_variance),
        (filters.depth_curvilinear_saliency, hessian_variance + 0.5 * (gx * gy) ** 2),
    ):
        vector = layer(ridge, sigma=sigma, depth_scale=1.0)[0, :, MIDDLE, MIDDLE]
        want = height * width / (width**2 + sigma**2 + variance) ** 1.5
        assert vector.norm() == pytest.approx(want, rel=3e-3)
        assert abs(float(vector[0]) * gx + float(vector[1]) * gy) / float(vector.norm()) > 0.999


@in_all_directions
def test_principal_curvature_image_of_a_line_in_all_directions(angle):
    line = 1.0 - torch.exp(-0.5 * (across(angle) / 2.0) ** 2)[None, None]
    vector = filters.principal_curvature_image(line)[0, :, MIDDLE, MIDDLE]
    assert vector.norm() == pytest.approx(2.8**2 * 2 / (4 + 2.8**2) ** 1.5, rel=0.03)
    gx, gy = direction(angle)
    assert abs(float(vector[0]) * gx + float(vector[1]) * gy) / float(vector.norm()) > 0.999
