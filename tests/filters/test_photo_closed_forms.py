"""Photograph layers on edges, lines and ramps with known results."""

import math

import pytest
import torch
from torch import Tensor

from curvireg_torch import filters

from .layer_cases import grid


def _edge(sigma: float, offset: float, size: int = 81) -> Tensor:
    x, _ = grid(size)
    return (0.2 + 0.6 * 0.5 * (1.0 + torch.erf((x - offset) / (sigma * math.sqrt(2.0)))))[None, None]


@pytest.mark.parametrize("mode", ["reblur-image", "reblur-saliency"])
@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.0, 4.0])
@pytest.mark.parametrize("transposed", [False, True])
def test_edge_blur_of_a_step_edge(mode: str, sigma: float, transposed: bool) -> None:
    image = _edge(sigma, 0.0)
    blur = filters.edge_blur(image.mT if transposed else image, mode=mode)[0, :, 40, 40]
    torch.testing.assert_close(blur, torch.full_like(blur, sigma), rtol=0.02, atol=0.0)


def test_multiscale_focus_curves_rank_edges_by_sharpness() -> None:
    x, _ = grid(121)
    sharp, blurred = (torch.erf((x - c) / (s * math.sqrt(2.0))) for c, s in ((-30.0, 1.0), (30.0, 3.0)))
    field = filters.multiscale_focus_curves((0.5 + 0.2 * (sharp - blurred))[None, None], saliency_weight=0.0)
    focus = field[0, :, 60].norm(dim=0)
    assert float(1 / focus[30]) == pytest.approx(math.sqrt(1 + 1), rel=0.03)  # includes the pre-smoothing of 1 px
    assert float(1 / focus[90]) == pytest.approx(math.sqrt(9 + 1), rel=0.03)


def test_image_gradient_and_curvilinear_saliency_of_a_ramp() -> None:
    x, y = grid(33)
    ramp = (0.03 * x - 0.04 * y)[None, None]
    inner = (..., slice(6, -6), slice(6, -6))
    gradient = filters.image_gradient(ramp)[inner]
    want = torch.tensor([0.03, -0.04], dtype=torch.float64).view(1, 2, 1, 1).expand_as(gradient)
    torch.testing.assert_close(gradient, want)
    torch.testing.assert_close(filters.image_curvilinear_saliency(ramp)[inner], want * 0.05)


def test_principal_curvature_image_of_a_dark_line() -> None:
    x, _ = grid(65)
    bright = torch.exp(-0.5 * (x / 2.0) ** 2)[None, None]
    field = filters.principal_curvature_image(1 - bright)[0, :, 32]
    assert int(field.norm(dim=0).argmax()) == 32
    # s^2 2 / (4 + s^2)^1.5 is largest at s = 2 sqrt 2, so the scale of 2.8 px has the maximum.
    assert float(field[:, 32].norm()) == pytest.approx(2.8**2 * 2 / (4 + 2.8**2) ** 1.5, rel=0.03)
    assert float(field[1, 32].abs()) < 1e-9
    assert float(filters.principal_curvature_image(bright)[0, :, 32, 32].norm()) < 1e-9


def test_multiscale_focus_curves_reject_edges_below_three_per_cent_of_the_contrast() -> None:
    """Two steps 60 px apart: the saliency goes with the square of the contrast, and its limit is 0.1 %."""
    x = torch.arange(121.0, dtype=torch.float64)
    for contrast, retained in ((0.04, True), (0.025, False)):
        image = (0.1 + 0.8 * (x > 30) + 0.8 * contrast * (x > 90)).expand(1, 1, 33, 121)
        focus = filters.multiscale_focus_curves(image, saliency_weight=0.0)[0, :, 16].norm(dim=0)
        assert float(focus[30]) > 0.5
        assert (float(focus[90]) > 0.5) == retained
