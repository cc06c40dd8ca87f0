"""Errors and recalls against scipy, numpy and loops; missing estimates (NaN, inf) are misses; bad
input is refused."""

import math
from functools import partial

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from curvireg_torch.evaluation import metrics
from curvireg_torch.geometry import rotation_error, rotation_from_axis_angle, transform
from tests._support import double, eye, refused, seeded, uniform
from tests._support.poses import poses, rotations
from tests._support.spies import spied

K = double([[600.0, 0.0, 320.0], [0.0, 620.0, 240.0], [0.0, 0.0, 1.0]])
POINTS = uniform(40, 3) - 0.5
GT = poses(5, 1)
EST = poses(5, 2, near=GT)
R = rotations(5, 0)
SYMMETRIES = eye(3)[None]


def _move(T, points=POINTS):
    T = np.asarray(T)
    return np.array([T[:3, :3] @ x + T[:3, 3] for x in points.numpy()])


def _project(xyz, camera):
    uvw = xyz @ camera.numpy().T
    return uvw[:, :2] / uvw[:, 2:]


def test_averages_count_missing_estimates_as_misses_and_thresholds_are_strict():
    degrees = torch.tensor([0.0, 9.999, 10.0, 29.0, 30.0, torch.inf])
    # Thresholds 0.05, 0.10, ..., 0.50: the errors pass 10, 9, 5, 0 (0.5 is not below 0.5) and 0 of
    # the ten.
    fractions = torch.tensor([0.0, 0.07, 0.26, 0.50, torch.inf])
    pixels = double([0.0, 7.0, 26.0, 50.0, torch.inf])
    for errors, thresholds, expected in (
        (degrees, (10.0,), 2 / 6),
        (degrees, (30.0,), 4 / 6),
        (fractions, metrics.MSSD_THRESHOLDS, 24 / 50),
        (fractions, metrics.ADD_THRESHOLDS, 2 / 5),
        (pixels / 640, metrics.MSPD_THRESHOLDS, 24 / 50),
        (pixels / 320, metrics.MSPD_THRESHOLDS, (10 + 8) / 50),
    ):
        assert metrics.average_recall(errors, thresholds) == pytest.approx(expected)
    for values, median in (([1.0, 2.0, torch.inf], 2.0), ([1.0, torch.inf, torch.inf], math.inf)):
        assert metrics.median_error(torch.tensor(values)) == median
    for n in (1, 6, 7):
        values = 180.0 * torch.rand(n, generator=seeded(n))
        assert metrics.median_error(values) == pytest.approx(float(np.median(values.numpy())))
    for score in (
        metrics.median_error,
        lambda errors: metrics.average_recall(errors, metrics.ADD_THRESHOLDS),
    ):
        assert math.isnan(score(degrees[:0]))
        for bad in ([-1.0], [math.nan], [[0.0, 0.0]], [1]):
            with refused("errors: expected"):
                score(torch.tensor(bad))


def test_symmetric_rotation_error_is_the_minimum_over_symmetries_and_identity():
    est = rotations(10, 2)
    gt = rotations(10, 3)
    symmetries = rotations(4, 4)
    group = [np.eye(3), *symmetries.numpy()]
    slow = [
        math.degrees(min(Rotation.from_matrix(e.T @ g @ s).magnitude() for s in group))
        for e, g in zip(est.numpy(), gt.numpy(), strict=True)
    ]
    assert_allclose(metrics.symmetric_rotation_error(est, gt, symmetries), slow, atol=1e-6)
    plain = metrics.symmetric_rotation_error(est, gt, torch.empty(0, 3, 3))
    assert_close(plain, rotation_error(est, gt))
    single = [x.float() for x in (est, gt, symmetries)]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_allclose(metrics.symmetric_rotation_error(*single), slow, atol=1e-3)
    assert metrics.symmetric_rotation_error(est[:0], gt[:0], symmetries).shape == (0,)


@pytest.mark.parametrize(
    ("value", "whole"), [(math.nan, True), (math.nan, False), (-math.inf, False)]
)
def test_rotation_errors_of_missing_estimates_are_infinite(value, whole):
    missing = R.clone()
    missing[2].view(-1)[slice(None) if whole else slice(0, 1)] = value
    for errors in (
        metrics.symmetric_rotation_error(missing, R, SYMMETRIES),
        metrics.symmetric_rotation_error(missing, R, SYMMETRIES[:0]),
    ):
        assert errors.isinf().tolist() == [False, False, True, False, False]
        assert errors[[0, 1, 3, 4]].max() < 1e-5


def test_add_and_adds_against_loops():
    add = [np.linalg.norm(_move(e) - _move(g), axis=1).mean() for e, g in zip(EST, GT, strict=True)]
    adds = [cdist(_move(g), _move(e)).min(1).mean() for e, g in zip(EST, GT, strict=True)]
    assert_allclose(metrics.add_error(EST, GT, POINTS), add)
    assert_allclose(metrics.adds_error(EST, GT, POINTS), adds)
    # The model is asymmetric, so the opposite direction of nearest neighbours gives another result.
    points = torch.cat([POINTS * 0.01, double([[3.0, 0.0, 0.0]])])
    est = poses(1, 3)
    gt = poses(1, 4)
    forward = cdist(_move(gt[0], points), _move(est[0], points)).min(1).mean()
    backward = cdist(_move(est[0], points), _move(gt[0], points)).min(1).mean()
    assert abs(forward - backward) > 0.01
    assert float(metrics.adds_error(est, gt, points)) == pytest.approx(forward)


def test_mssd_and_mspd_against_loops(monkeypatch):
    symmetries = torch.stack([eye(4), *poses(3, 5)])
    symmetries[:, :3, 3] *= 0.02
    cameras = K.repeat(5, 1, 1)
    cameras[:, 0, 0] += 50.0 * torch.arange(5)
    mssd = []
    mspd = []
    for e, g, camera in zip(EST, GT, cameras, strict=True):
        turned = [_move(g.numpy() @ s.numpy()) for s in symmetries]
        mssd.append(min(np.linalg.norm(_move(e) - points, axis=1).max() for points in turned))
        pixels = [_project(_move(e), camera) - _project(points, camera) for points in turned]
        mspd.append(min(np.linalg.norm(difference, axis=1).max() for difference in pixels))
    # all at once; two transforms at a time, bounds by few points
    for chunk, few in ((metrics._CHUNK, 300), (90, 3)):
        monkeypatch.setattr(metrics, "_CHUNK", chunk)
        monkeypatch.setattr(metrics, "BOUNDING_POINTS", few)
        assert_allclose(metrics.mssd_error(EST, GT, POINTS, symmetries=symmetries), mssd)
        assert_allclose(metrics.mspd_error(EST, GT, POINTS, cameras, symmetries=symmetries), mspd)


def test_rotations_count_as_symmetries_without_translation():
    turns = torch.cat([SYMMETRIES, R])
    symmetries = transform(turns, torch.zeros(6, 3).double())
    for error in (metrics.mssd_error, partial(metrics.mspd_error, camera_matrix=K)):
        expected = error(EST, GT, POINTS, symmetries=symmetries)
        assert torch.equal(error(EST, GT, POINTS, symmetries=turns), expected)


def test_few_symmetries_of_a_solid_of_revolution_are_compared_by_all_points(monkeypatch):
    """Scores of cans with 315 symmetries took minutes."""
    symmetries = eye(4).repeat(315, 1, 1)
    angles = torch.arange(315).double() * (2.0 * math.pi / 315)
    symmetries[:, :3, :3] = rotation_from_axis_angle(angles[:, None] * double([0.0, 0.0, 1.0]))
    points = uniform(6000, 3) - 0.5
    moved = spied(monkeypatch, metrics, "_transform")
    metrics.mssd_error(EST, GT, points, symmetries=symmetries)
    metrics.mspd_error(EST, GT, points, K, symmetries=symmetries)
    assert sum(len(T) * len(x) for T, x in moved) < 0.25 * 3 * len(EST) * 315 * len(points)


def test_mspd_error_is_infinite_for_points_behind_the_camera():
    behind = EST.clone()
    behind[2, 2, 3] = 0.1
    mspd = metrics.mspd_error(behind, GT, POINTS, K)
    assert mspd.isinf().tolist() == [False, False, True, False, False]
    assert metrics.mssd_error(behind, GT, POINTS).isfinite().all()


ERRORS = [
    metrics.add_error,
    metrics.adds_error,
    metrics.mssd_error,
    lambda *poses: metrics.mspd_error(*poses, K),
]


@pytest.mark.parametrize("error", ERRORS)
def test_pose_errors_contract(error):
    whole = error(EST, GT, POINTS)
    for value in (math.nan, math.inf):
        missing = EST.clone()
        missing[1, 0, 0] = value
        want = torch.where(torch.arange(5) == 1, math.inf, whole)
        assert_close(error(missing, GT, POINTS), want)
    one_by_one = [error(e[None], g[None], POINTS) for e, g in zip(EST, GT, strict=True)]
    assert_close(torch.cat(one_by_one), whole)
    assert error(EST[:0], GT[:0], POINTS).shape == (0,)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        single = error(EST.float(), GT.float(), POINTS.float())
    assert single.dtype == torch.float32
    assert_close(single.double(), whole, rtol=1e-3, atol=1e-5)
    half = EST.half()
    assert torch.equal(error(half, GT, POINTS), error(half.double(), GT, POINTS))
    assert error(half, half, POINTS.half()).dtype == torch.float32
    # would map every point to the origin, which may be close to the surface
    zero = torch.zeros_like(EST)
    for est, gt, points, message in (
        (EST, GT, POINTS[:0], "points: expected at least one"),
        (EST, GT, POINTS * math.nan, "points: expected finite"),
        (EST, GT[:2], POINTS, "T_gt: expected shape"),
        (EST, GT * math.nan, POINTS, "T_gt: expected finite"),
        *((bad, GT, POINTS, "T_est: expected rigid") for bad in (zero, EST * 1.05, EST.mT, -EST)),
        (EST, GT * 1.05, POINTS, "T_gt: expected rigid"),
    ):
        with refused(message):
            error(est, gt, points)


def test_metrics_refuse_wrong_input():
    for thresholds in ([], iter([0.1])):
        with refused("^thresholds: expected"):
            metrics.average_recall(torch.rand(3), thresholds)
    for message, *given in (
        ("R_est: expected", R[0, 0], R, SYMMETRIES),
        ("R_gt: expected", R, R.tolist(), SYMMETRIES),
        ("R_gt: expected finite", R, R * math.nan, SYMMETRIES),
        ("symmetries: expected finite", R, R, SYMMETRIES * math.nan),
    ):
        with refused(f"^{message}"):
            metrics.symmetric_rotation_error(*given)
    with refused("^symmetries: expected shape .* with S >= 1"):
        metrics.mssd_error(EST, GT, POINTS, symmetries=GT[:0])
    for message, camera, symmetries in (
        ("symmetries: expected", K, GT * math.inf),
        ("camera_matrix: expected", K[None].repeat(2, 1, 1), None),
        ("camera matrix: expected finite", K * math.nan, None),
    ):
        with refused(f"^{message}"):
            metrics.mspd_error(EST, GT, POINTS, camera, symmetries=symmetries)
