"""Precision at rank k and errors of viewpoint parameters."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from curvireg_torch import metrics
from curvireg_torch.errors import InvalidInputError


def _case(seed: int = 0, queries: int = 40, views: int = 30) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    errors = 180.0 * torch.rand(queries, views, generator=g)
    return (errors + 60.0 * torch.randn(queries, views, generator=g)).argsort(1), errors


def test_rank_precision_against_a_loop() -> None:
    order, errors = _case()
    nearest = metrics.rank_precision(order, errors)
    within = metrics.rank_precision(order, errors, threshold_deg=20.0)
    assert list(nearest) == list(within) == [1, 3, 5, 10, 20]
    for k in nearest:
        found = [int(np.argmin(e)) in o[:k] for o, e in zip(order.numpy(), errors.numpy(), strict=True)]
        close = [any(e[v] < 20.0 for v in o[:k]) for o, e in zip(order.numpy(), errors.numpy(), strict=True)]
        assert nearest[k] == pytest.approx(np.mean(found))
        assert within[k] == pytest.approx(np.mean(close))
    assert nearest != within


def test_rank_precision_counts_all_views_of_the_nearest_rotation() -> None:
    errors = torch.tensor([[10.0, 10.00001, 50.0]])
    assert metrics.rank_precision(torch.tensor([[1, 2, 0]]), errors, ks=(1,)) == {1: 1.0}
    assert metrics.rank_precision(torch.tensor([[2, 1, 0]]), errors, ks=(1,)) == {1: 0.0}


def test_rank_precision_of_large_ranks_and_partial_orders() -> None:
    order, errors = _case(views=4)
    assert metrics.rank_precision(order, errors, ks=(20,)) == {20: 1.0}
    assert metrics.rank_precision(order[:, :2], errors, ks=(1, 2)) == metrics.rank_precision(order, errors, ks=(1, 2))
    with pytest.raises(InvalidInputError, match="order: expected"):
        metrics.rank_precision(order[:, :2], errors, ks=(3,))


def test_rank_precision_of_no_queries_and_of_bad_input() -> None:
    order, errors = _case(queries=2, views=3)
    assert math.isnan(metrics.rank_precision(order[:0], errors[:0], ks=(1,))[1])
    for wrong, options, match in (
        ((order, errors), {"ks": ()}, "ks"),
        ((order, errors), {"ks": (0,)}, "ks"),
        ((order, errors), {"threshold_deg": 0.0}, "threshold_deg"),
        ((order + 1, errors), {"ks": (3,)}, "order: expected indices"),
        ((order.float(), errors), {"ks": (3,)}, "order: expected integers"),
        ((order, errors * math.nan), {"ks": (3,)}, "NaN"),
        ((order[:, :0], errors[:, :0]), {"ks": (1,)}, "at least one view"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            metrics.rank_precision(*wrong, **options)


def test_viewpoint_differences_are_circular_in_azimuth_and_theta() -> None:
    a = torch.tensor([[359.0, 80.0, -179.0, 1.0], [10.0, -80.0, 10.0, 3.0], [0.0, 0.0, 0.0, 400.0]])
    b = torch.tensor([[1.0, -80.0, 179.0, 2.5], [725.0, -70.0, -20.0, 3.0], [180.0, 0.0, 0.0, 10.0]])
    expected = [[2.0, 160.0, 2.0, 1.5], [5.0, 10.0, 30.0, 0.0], [180.0, 0.0, 0.0, 390.0]]
    torch.testing.assert_close(metrics.viewpoint_differences(a, b), torch.tensor(expected))


def _view_grid() -> torch.Tensor:
    axes = ([0.0, 40.0, 80.0, 120.0, 200.0, 280.0, 320.0], [-30.0, 0.0, 30.0], [-10.0, 10.0], [1.0, 2.0])
    return torch.cartesian_prod(*map(torch.tensor, axes))


def test_closest_view_against_scipy() -> None:
    views = _view_grid()
    near, far = [[15.0, 5.0, 2.0, 1.1], [200.0, -20.0, -9.0, 1.9]], [[345.0, 60.0, 30.0, 9.0], [101.0, 10.0, 1.0, 0.1]]
    truth = torch.tensor(near + far)

    def rotation(v: np.ndarray) -> Rotation:  # Rz(theta) Rx(e - 90) Rz(-a): the same angles between any two
        return Rotation.from_euler("ZXZ", np.stack([v[:, 2], v[:, 1] - 90.0, -v[:, 0]], 1), degrees=True)

    bank = rotation(views.numpy())
    closest = metrics.closest_view(views, truth)
    for i, t in enumerate(truth.numpy()):
        angles = np.degrees((bank.inv() * rotation(t[None])).magnitude())
        best = np.flatnonzero(angles < angles.min() + 1e-2)
        assert int(closest[i]) == best[np.argmin(np.abs(views.numpy()[best, 3] - t[3]))]


def test_pose_parameter_errors_worked_example() -> None:
    views = torch.tensor([[0.0, 0.0, 0.0, 1.0], [90.0, 20.0, 0.0, 1.0], [350.0, 10.0, 10.0, 2.0]])
    truth = torch.tensor([[5.0, 2.0, 1.0, 1.25], [80.0, 20.0, -4.0, 1.0]])
    estimate = torch.stack([views[2], views[1]])
    table = metrics.pose_parameter_errors(estimate, truth, views)
    assert table["est"] == pytest.approx({"azimuth": 12.5, "elevation": 4.0, "theta": 6.5, "distance": 0.375})
    assert table["clo"] == pytest.approx({"azimuth": 7.5, "elevation": 1.0, "theta": 2.5, "distance": 0.125})


def test_pose_parameter_errors_of_empty_sets() -> None:
    views = _view_grid()
    table = metrics.pose_parameter_errors(views[:0], views[:0], views)
    assert all(math.isnan(x) for row in table.values() for x in row.values())
    with pytest.raises(InvalidInputError, match="at least one view"):
        metrics.closest_view(views[:0], views)
    with pytest.raises(InvalidInputError, match="estimate"):
        metrics.pose_parameter_errors(views[:1], views[:2], views)
