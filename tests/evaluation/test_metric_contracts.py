"""Contracts of all metrics: missing estimates (NaN or inf) are misses, and bad input is refused."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import metrics
from tests._support.poses import poses, rotations

R, T = rotations(3, 0), poses(3, 1)
POINTS = torch.rand(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
K = torch.tensor([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
SYMMETRIES = torch.eye(3, dtype=torch.float64)[None]
AXIS = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def corrupt(x: Tensor, value: float, *, whole: bool = False) -> Tensor:
    """``x`` with ``value`` in the last of its three items, in all of it or in its first number."""
    x = x.clone()
    x[2].view(-1)[slice(None) if whole else slice(0, 1)] = value
    return x


corruptions = pytest.mark.parametrize(
    ("value", "whole"), [(math.nan, True), (math.nan, False), (math.inf, True), (-math.inf, False)]
)


@corruptions
def test_rotation_errors_of_missing_estimates_are_infinite(value: float, whole: bool) -> None:
    missing = corrupt(R, value, whole=whole)
    for errors in (
        metrics.symmetric_rotation_error(missing, R, SYMMETRIES),
        metrics.symmetric_rotation_error(missing, R, SYMMETRIES[:0]),
        metrics.axis_rotation_error(missing, R, AXIS),
    ):
        assert errors[2] == math.inf
        torch.testing.assert_close(errors[:2], torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-5)
        assert [metrics.accuracy(errors, limit) for limit in (30.0, 10.0)] == pytest.approx([2 / 3, 2 / 3])
        assert metrics.median_error(errors) == pytest.approx(0.0, abs=1e-5)
    pairs = metrics.symmetric_rotation_error(missing[:, None], R, SYMMETRIES).isinf()
    assert pairs.tolist() == [[False] * 3, [False] * 3, [True] * 3]


@pytest.mark.parametrize("bins", metrics.AVP_BINS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_binned_accuracy_counts_missing_azimuths_as_misses(bins: int, value: float) -> None:
    for truth in torch.arange(0.0, 360.0, 360.0 / bins):  # any bin to which NaN could be cast
        assert metrics.binned_accuracy(torch.tensor([value, 3.0]), torch.tensor([float(truth), 3.0]), bins) == 0.5
    with pytest.raises(InvalidInputError, match="azimuth: expected finite"):
        metrics.azimuth_bin(torch.tensor([0.0, value]), bins)


def test_azimuth_bin_of_a_very_large_angle() -> None:
    far = torch.tensor([90.0 + 360.0 * 2**60], dtype=torch.float64)  # exceeds int64 in degrees; a multiple of 45
    assert metrics.azimuth_bin(far, 8).tolist() == [int(float(far) % 360.0 / 45.0)]


@corruptions
def test_recalls_count_missing_poses_as_misses(value: float, whole: bool) -> None:
    missing = corrupt(T, value, whole=whole)
    recalls = [
        metrics.add_recall(metrics.add_error(missing, T, POINTS), 1.0),
        metrics.add_recall(metrics.adds_error(missing, T, POINTS), 1.0),
        metrics.mssd_recall(metrics.mssd_error(missing, T, POINTS), 1.0),
        metrics.mspd_recall(metrics.mspd_error(missing, T, POINTS, K), 640),
    ]
    assert recalls == pytest.approx([2 / 3] * 4)
    assert metrics.adds_error(missing, T, POINTS)[2] == math.inf


def _zero_matrix(T: Tensor) -> Tensor:
    T = T.clone()
    T[1] = 0.0
    return T


@pytest.mark.parametrize("bad", [_zero_matrix, lambda T: T * 1.05, lambda T: T.mT, lambda T: -T])
def test_pose_errors_reject_poses_that_are_not_rigid(bad: Callable[[Tensor], Tensor]) -> None:
    # A zero matrix would map every point to the origin, which for ADD-S may be close to the surface.
    for name, arguments in (("T_est", (bad(T), T)), ("T_gt", (T, bad(T)))):
        for error in (metrics.add_error, metrics.adds_error, metrics.mssd_error):
            with pytest.raises(InvalidInputError, match=f"{name}: expected rigid"):
                error(*arguments, POINTS)


def test_pose_errors_accept_rounded_poses() -> None:
    rounded = T.clone()
    rounded[:, :3, :3] = (rounded[:, :3, :3] * 1000.0).round() / 1000.0  # three digits, as in some result files
    assert float(metrics.mssd_error(rounded, T, POINTS).max()) < 2e-3
    assert metrics.mssd_error(T.half(), T, POINTS).isfinite().all()


NOT_FINITE: dict[str, Callable[[float], object]] = {
    "R_gt": lambda bad: metrics.symmetric_rotation_error(R, corrupt(R, bad), SYMMETRIES),
    "R_gt of axis": lambda bad: metrics.axis_rotation_error(R, corrupt(R, bad), AXIS),
    "symmetries": lambda bad: metrics.symmetric_rotation_error(R, R, SYMMETRIES * bad),
    "axis": lambda bad: metrics.axis_rotation_error(R, R, AXIS * bad),
    "azimuth": lambda bad: metrics.binned_accuracy(torch.zeros(2), torch.tensor([0.0, bad]), 4),
    "symmetries of poses": lambda bad: metrics.mssd_error(T, T, POINTS, symmetries=T * bad),
    "symmetries of projections": lambda bad: metrics.mspd_error(T, T, POINTS, K, symmetries=T * bad),
    "camera matrix": lambda bad: metrics.mspd_error(T, T, POINTS, K * bad),
    "points": lambda bad: metrics.add_error(T, T, POINTS * bad),
    "diameter": lambda bad: metrics.add_recall(torch.ones(1), bad),
}


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("name", NOT_FINITE)
def test_metrics_reject_truth_that_is_not_finite(name: str, bad: float) -> None:
    with pytest.raises(InvalidInputError, match=name.split(" of ")[0] + ": expected"):
        NOT_FINITE[name](bad)


WRONG: dict[str, Callable[[], object]] = {
    "R_est": lambda: metrics.symmetric_rotation_error(R[0, 0], R, SYMMETRIES),
    "R_gt": lambda: metrics.axis_rotation_error(R, R.tolist(), AXIS),  # type: ignore[arg-type]
    "azimuth": lambda: metrics.azimuth_bin([3.0], 4),  # type: ignore[arg-type]
    "camera_matrix": lambda: metrics.mspd_error(T, T, POINTS, K[None].repeat(2, 1, 1)),
    "camera_matrix: expected a torch.Tensor": lambda: metrics.mspd_error(T, T, POINTS, K.tolist()),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("name", WRONG)
def test_metrics_reject_wrong_types_and_shapes(name: str) -> None:
    with pytest.raises(InvalidInputError, match=rf"^{name}"):
        WRONG[name]()


OTHER_DEVICE: dict[str, Callable[[Callable[[Tensor], Tensor]], object]] = {
    "R_est": lambda to: metrics.symmetric_rotation_error(to(R), R, SYMMETRIES),
    "symmetries": lambda to: metrics.symmetric_rotation_error(R, R, to(SYMMETRIES)),
    "axis": lambda to: metrics.axis_rotation_error(R, R, to(AXIS)),
    "T_gt": lambda to: metrics.add_error(T, to(T), POINTS),
    "points": lambda to: metrics.add_error(T, T, to(POINTS)),
    "camera_matrix": lambda to: metrics.mspd_error(T, T, POINTS, to(K)),
    "diameter": lambda to: metrics.add_recall(torch.ones(1), to(torch.ones(1))),
}


@pytest.mark.parametrize("name", OTHER_DEVICE)
def test_metrics_reject_tensors_on_different_devices(name: str) -> None:
    with pytest.raises(InvalidInputError, match=rf"^{name}: expected device cpu, got meta"):
        OTHER_DEVICE[name](lambda x: x.to("meta"))


def test_metrics_of_empty_sets() -> None:
    empty = torch.empty(0, dtype=torch.float64)
    assert metrics.symmetric_rotation_error(R[:0], R[:0], SYMMETRIES).shape == (0,)
    assert metrics.axis_rotation_error(R[:0], R[:0], AXIS).shape == (0,)
    assert metrics.azimuth_bin(empty, 4).shape == (0,)
    averages = (
        metrics.accuracy(empty, 30.0),
        metrics.median_error(empty),
        metrics.binned_accuracy(empty, empty, 4),
        metrics.add_recall(empty, 1.0),
        metrics.mssd_recall(empty, 1.0),
        metrics.mspd_recall(empty, 640),
    )
    assert all(math.isnan(average) for average in averages)
