"""Pose errors and recalls against loops and worked examples."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.evaluation import metrics
from tests._support.poses import poses

K = torch.tensor([[600.0, 0.0, 320.0], [0.0, 620.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
POINTS = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
GT = poses(5, 1)
EST = poses(5, 2, near=GT)


def _move(T: torch.Tensor | np.ndarray, points: torch.Tensor = POINTS) -> np.ndarray:
    T = np.asarray(T)
    return np.array([T[:3, :3] @ x + T[:3, 3] for x in points.numpy()])


def _project(xyz: np.ndarray, camera: torch.Tensor = K) -> np.ndarray:
    uvw = xyz @ camera.numpy().T
    return uvw[:, :2] / uvw[:, 2:]


def test_add_and_adds_against_loops() -> None:
    add = [np.linalg.norm(_move(e) - _move(g), axis=1).mean() for e, g in zip(EST, GT, strict=True)]
    adds = [cdist(_move(g), _move(e)).min(1).mean() for e, g in zip(EST, GT, strict=True)]
    np.testing.assert_allclose(metrics.add_error(EST, GT, POINTS), add)
    np.testing.assert_allclose(metrics.adds_error(EST, GT, POINTS), adds)
    assert np.all(np.array(adds) < add)


def test_adds_error_queries_the_points_of_the_true_pose() -> None:
    # The model is asymmetric, so the opposite direction of nearest neighbours gives another result.
    points = torch.cat([POINTS * 0.01, torch.tensor([[3.0, 0.0, 0.0]], dtype=torch.float64)])
    est, gt = poses(1, 3), poses(1, 4)
    forward = cdist(_move(gt[0], points), _move(est[0], points)).min(1).mean()
    backward = cdist(_move(est[0], points), _move(gt[0], points)).min(1).mean()
    assert abs(forward - backward) > 0.01
    assert float(metrics.adds_error(est, gt, points)) == pytest.approx(forward)


def test_mssd_and_mspd_against_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    symmetries = torch.stack([torch.eye(4, dtype=torch.float64), *poses(3, 5)])
    symmetries[:, :3, 3] *= 0.02
    cameras = K.repeat(5, 1, 1)
    cameras[:, 0, 0] += 50.0 * torch.arange(5)
    mssd, mspd = [], []
    for e, g, camera in zip(EST, GT, cameras, strict=True):
        in_space = [np.linalg.norm(_move(e) - _move(g.numpy() @ s.numpy()), axis=1).max() for s in symmetries]
        in_image = [
            np.linalg.norm(_project(_move(e), camera) - _project(_move(g.numpy() @ s.numpy()), camera), axis=1).max()
            for s in symmetries
        ]
        mssd.append(min(in_space))
        mspd.append(min(in_image))
    for chunk in (metrics._CHUNK, 90):  # all at once, and two transforms at a time
        monkeypatch.setattr(metrics, "_CHUNK", chunk)
        np.testing.assert_allclose(metrics.mssd_error(EST, GT, POINTS, symmetries=symmetries), mssd)
        np.testing.assert_allclose(metrics.mspd_error(EST, GT, POINTS, cameras, symmetries=symmetries), mspd)


def test_mssd_and_mspd_apply_symmetries_in_the_model_frame() -> None:
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    symmetries = torch.stack([torch.eye(4, dtype=torch.float64), half_turn])
    assert float(metrics.mssd_error(GT @ half_turn, GT, POINTS, symmetries=symmetries).max()) < 1e-12
    assert float(metrics.mspd_error(GT @ half_turn, GT, POINTS, K, symmetries=symmetries).max()) < 1e-9
    assert float(metrics.mssd_error(GT @ half_turn, GT, POINTS).min()) > 0.5
    assert float(metrics.mssd_error(half_turn @ GT, GT, POINTS, symmetries=symmetries).min()) > 0.5


def test_mspd_error_is_infinite_for_points_behind_the_camera() -> None:
    behind = EST.clone()
    behind[2, 2, 3] = 0.1
    mspd = metrics.mspd_error(behind, GT, POINTS, K)
    assert mspd.isinf().tolist() == [False, False, True, False, False]
    assert bool(metrics.mssd_error(behind, GT, POINTS).isfinite().all())


ERRORS: list[Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]] = [
    metrics.add_error,
    metrics.adds_error,
    metrics.mssd_error,
    lambda est, gt, points: metrics.mspd_error(est, gt, points, K),
]


@pytest.mark.parametrize("error", ERRORS)
def test_pose_errors_contract(error: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]) -> None:
    whole = error(EST, GT, POINTS)
    missing = torch.where(torch.arange(5).view(5, 1, 1) == 1, math.nan, EST)
    want = torch.where(torch.arange(5) == 1, math.inf, whole)
    torch.testing.assert_close(error(missing, GT, POINTS), want)
    one_by_one = [error(e[None], g[None], POINTS) for e, g in zip(EST, GT, strict=True)]
    torch.testing.assert_close(torch.cat(one_by_one), whole)
    assert error(EST[:0], GT[:0], POINTS).shape == (0,)
    single = error(EST.float(), GT, POINTS)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), whole, rtol=1e-3, atol=1e-5)
    for gt, points, message in (
        (GT, POINTS[:0], "points: expected at least one"),
        (GT[:2], POINTS, "T_gt: expected shape"),
        (GT * math.nan, POINTS, "T_gt: expected finite"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            error(EST, gt, points)


def test_recalls_worked_example() -> None:
    errors = torch.tensor([0.0, 7.0, 26.0, 50.0, torch.inf])
    # Diameter 100, thresholds 5, 10, ..., 50: the errors pass 10, 9, 5, 0 (50 is not below 50) and 0 of the ten.
    assert metrics.mssd_recall(errors, 100.0) == pytest.approx(24 / 50)
    assert metrics.mspd_recall(errors, 640) == pytest.approx(24 / 50)
    assert metrics.mspd_recall(errors, 320) == pytest.approx((10 + 8) / 50)  # equivalent to 0, 14, 52 and 100 px
    assert metrics.add_recall(errors, 100.0) == pytest.approx(2 / 5)
    assert metrics.add_recall(errors, 100.0, fraction=0.3) == pytest.approx(3 / 5)


def test_recalls_of_objects_of_different_sizes() -> None:
    errors, diameters = torch.tensor([7.0, 7.0]), torch.tensor([100.0, 20.0])
    assert metrics.add_recall(errors, diameters) == 0.5
    assert metrics.mssd_recall(errors, diameters) == pytest.approx((9 + 3) / 20)  # 0.07 and 0.35 diameters
    assert metrics.mspd_recall(errors, torch.tensor([640.0, 128.0])) == pytest.approx((9 + 3) / 20)


def test_pose_metrics_reject_bad_input() -> None:
    for call, message in (
        (lambda: metrics.mssd_error(EST, GT, POINTS, symmetries=torch.empty(0, 4, 4)), "at least the identity"),
        (lambda: metrics.mssd_recall(torch.ones(2), 0.0), "diameter: expected finite numbers > 0"),
        (lambda: metrics.add_recall(torch.ones(2), torch.ones(3)), "diameter: expected a number or shape"),
        (lambda: metrics.add_recall(torch.ones(2), 1.0, fraction=0.0), "fraction"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            call()
    for recall in (metrics.mspd_recall, metrics.mssd_recall, metrics.add_recall):
        for bad in (math.nan, -1.0):
            with pytest.raises(InvalidInputError, match="errors: expected numbers >= 0"):
                recall(torch.tensor([bad]), 640)
