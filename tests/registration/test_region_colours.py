"""Where colours say that an object ends: closed forms of the posterior and of the histograms."""

import math

import pytest
import torch

from curvireg_torch.registration.tracker import HALF_RATE_COUNT, RegionModel, colour_bins, line_posterior


def test_posterior_is_that_of_bayes():
    ratio = torch.tensor([[0.3, -0.2, 0.9, -1.1, 0.4]], dtype=torch.float64)
    likelihood = [math.exp(0.3), math.exp(0.1), math.exp(1.0), math.exp(-0.1)]  # ends at -1.5, -0.5, 0.5, 1.5
    p = torch.tensor(likelihood) / sum(likelihood)
    d = torch.tensor([-1.5, -0.5, 0.5, 1.5])
    mean, variance = line_posterior(ratio, 2)
    assert float(mean) == pytest.approx(float((p * d).sum()), abs=1e-6)
    assert float(variance) == pytest.approx(float((p * d**2).sum() - (p * d).sum() ** 2), abs=1e-6)


def halves():
    """A red left half and a green right half; pixel columns of 8 lines that point to the right from the middle."""
    colours = torch.zeros(1, 3, 16, 16)
    colours[:, 0, :, :8], colours[:, 1, :, 8:] = 1.0, 1.0
    y, x = torch.meshgrid(torch.arange(4.0, 12.0), torch.arange(16.0), indexing="ij")
    return colour_bins(colours), torch.stack([x, y], dim=-1)


def test_log_ratio_has_the_sign_of_the_learned_colours():
    bins, uv = halves()
    model, zero = RegionModel(), torch.zeros(8)
    model.learn(bins, uv.flatten(0, 1), zero.repeat_interleave(16), (uv[..., 0] < 8).flatten())
    ratio = model.log_ratio(bins, uv, zero)
    assert (ratio[:, :8] > 0.3).all()
    assert (ratio[:, 8:] < -0.3).all()
    opposite = model.log_ratio(bins, uv, zero + math.pi)  # nothing learned there but the mean of all directions
    assert (opposite[:, :8] > 0.1).all()
    assert (opposite[:, :8] < ratio[:, :8]).all()
    outside = model.log_ratio(bins, uv - 100.0, zero)
    assert (outside == 0).all()


def test_histograms_move_by_the_rate_towards_new_colours():
    bins, uv = halves()
    model, directions = RegionModel(), torch.zeros(128)
    red, green = bins[0, 0], bins[0, 15]
    model.learn(bins, uv.flatten(0, 1), directions, (uv[..., 0] < 8).flatten())
    assert float(model._histograms[0, 0, red]) == 1.0
    model.learn(bins, uv.flatten(0, 1), directions, (uv[..., 0] >= 8).flatten())  # the colours swap
    step = 0.2 * 64 / (64 + HALF_RATE_COUNT)
    assert float(model._histograms[0, 0, green]) == pytest.approx(step)
    assert float(model._histograms[0, 0, red]) == pytest.approx(1.0 - step)
