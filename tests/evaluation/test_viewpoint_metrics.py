"""Rotation errors and their averages against scipy and numpy."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import logm
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import metrics
from curvireg_torch.geometry import rotation_error
from tests._support.poses import rotations


def _angle(R1: np.ndarray, R2: np.ndarray) -> float:
    return math.degrees(Rotation.from_matrix(R1.T @ R2).magnitude())


def test_accuracy_threshold_is_strict_and_missing_estimates_are_misses() -> None:
    errors = torch.tensor([0.0, 9.999, 10.0, 29.0, 30.0, torch.inf])
    assert metrics.accuracy(errors, 10.0) == pytest.approx(2 / 6)
    assert metrics.accuracy(errors, 30.0) == pytest.approx(4 / 6)


@pytest.mark.parametrize("n", [1, 6, 7])
def test_median_error_agrees_with_numpy(n: int) -> None:
    errors = 180.0 * torch.rand(n, generator=torch.Generator().manual_seed(n))
    assert metrics.median_error(errors) == pytest.approx(float(np.median(errors.numpy())))


def test_median_error_with_missing_estimates() -> None:
    for errors, median in (([1.0, 2.0, torch.inf], 2.0), ([1.0, torch.inf, torch.inf], math.inf)):
        assert metrics.median_error(torch.tensor(errors)) == median
    assert metrics.median_error(torch.tensor([torch.inf, torch.inf])) == math.inf


def test_legacy_sqrt2_equals_the_spectral_norm_of_the_logarithm() -> None:
    a, b = rotations(25, 0), rotations(25, 1)
    logarithms = [np.real(logm(x.T @ y)) for x, y in zip(a.numpy(), b.numpy(), strict=True)]
    flawed = np.degrees([np.linalg.norm(x, 2) / math.sqrt(2) for x in logarithms])
    errors = rotation_error(a, b)
    assert metrics.median_error(errors, legacy_sqrt2=True) == pytest.approx(float(np.median(flawed)), rel=1e-6)
    threshold = 80.0
    expected = float(np.mean(flawed < threshold))
    assert metrics.accuracy(errors, threshold, legacy_sqrt2=True) == pytest.approx(expected)
    assert metrics.accuracy(errors, threshold) < expected


@pytest.mark.parametrize("bad", [torch.tensor([-1.0]), torch.tensor([math.nan]), torch.zeros(2, 2), torch.tensor([1])])
def test_accuracy_and_median_error_reject_bad_input(bad: torch.Tensor) -> None:
    for average in (lambda errors: metrics.accuracy(errors, 30.0), metrics.median_error):
        with pytest.raises(InvalidInputError, match="errors: expected"):
            average(bad)
    with pytest.raises(InvalidInputError, match="threshold_deg"):
        metrics.accuracy(torch.zeros(1), 0.0)


def test_symmetric_rotation_error_is_the_minimum_over_symmetries_and_identity() -> None:
    est, gt, symmetries = rotations(10, 2), rotations(10, 3), rotations(4, 4)
    group = [np.eye(3), *symmetries.numpy()]
    slow = [min(_angle(e, g @ s) for s in group) for e, g in zip(est.numpy(), gt.numpy(), strict=True)]
    np.testing.assert_allclose(metrics.symmetric_rotation_error(est, gt, symmetries), slow, atol=1e-6)
    plain = metrics.symmetric_rotation_error(est, gt, torch.empty(0, 3, 3))
    torch.testing.assert_close(plain, rotation_error(est, gt))


def test_symmetric_rotation_error_applies_symmetries_in_the_model_frame() -> None:
    gt = rotations(1, 5)[0]
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    assert float(metrics.symmetric_rotation_error(gt @ quarter, gt, quarter[None])) < 1e-6
    assert float(metrics.symmetric_rotation_error(quarter @ gt, gt, quarter[None])) > 1.0


def test_axis_rotation_error_is_the_minimum_over_rotations_about_the_axis() -> None:
    est, gt = rotations(6, 8), rotations(6, 9)
    axis = torch.tensor([0.3, -2.0, 1.1], dtype=torch.float64)
    unit = (axis / axis.norm()).numpy()

    def at(phi: float, e: np.ndarray, g: np.ndarray) -> float:
        return _angle(e, g @ Rotation.from_rotvec(phi * unit).as_matrix())

    for e, g in zip(est.numpy(), gt.numpy(), strict=True):
        grid = np.linspace(0.0, 2 * np.pi, 73)
        start = grid[np.argmin([at(phi, e, g) for phi in grid])]
        slow = minimize_scalar(at, args=(e, g), bounds=(start - 0.1, start + 0.1), method="bounded").fun
        ours = metrics.axis_rotation_error(torch.from_numpy(e), torch.from_numpy(g), axis)
        assert float(ours) == pytest.approx(slow, abs=1e-3)


def test_axis_rotation_error_broadcasts_and_rejects_a_zero_axis() -> None:
    bank, query = rotations(5, 10), rotations(2, 11)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert metrics.axis_rotation_error(bank, query[:, None], axis).shape == (2, 5)
    with pytest.raises(InvalidInputError, match="length > 0"):
        metrics.axis_rotation_error(bank, bank, torch.zeros(3))


@pytest.mark.parametrize("bins", [4, 8, 16, 24])
def test_azimuth_bins_are_centred_on_multiples_of_the_step(bins: int) -> None:
    step = 360.0 / bins
    for i in range(bins):
        inside = torch.tensor([i - 0.5, i - 0.49, i, i + 0.49], dtype=torch.float64) * step
        assert metrics.azimuth_bin(inside, bins).tolist() == [i] * 4
        assert metrics.azimuth_bin(inside % 360.0, bins).tolist() == [i] * 4


def test_binned_accuracy_worked_example() -> None:
    gt = torch.tensor([0.0, 10.0, 44.0, 180.0])
    est = torch.tensor([350.0, 30.0, 46.0, 0.0])
    assert metrics.binned_accuracy(est, gt, 4) == 0.5  # correct, correct, across the edge at 45, wrong
    assert metrics.binned_accuracy(est, gt, 8) == 0.5  # correct, across the edge at 22.5, correct, wrong
    assert metrics.binned_accuracy(est, gt, 24) == 0.25  # only 44 and 46 (bin 45 +- 7.5) agree
    with pytest.raises(InvalidInputError, match="bins"):
        metrics.binned_accuracy(est, gt, 5)
    with pytest.raises(InvalidInputError, match="azimuth_est"):
        metrics.binned_accuracy(est[:2], gt, 4)
