"""Agreement of feature points against distance matrices and scikit-image."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from curvireg_torch import metrics
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.terms.repeatability import dilate_points, repeatability


def _masks(seed: int, n: int = 4, density: float = 0.02) -> torch.Tensor:
    return torch.rand(n, 24, 31, generator=torch.Generator().manual_seed(seed)) < density


def _slow_distances(a: torch.Tensor, b: torch.Tensor) -> np.ndarray:
    """Distance of each point of a to the nearest point of b."""
    return cdist(np.argwhere(a.numpy()), np.argwhere(b.numpy())).min(1)


@pytest.mark.parametrize("eps", [0.0, 1.0, math.sqrt(2.0), 3.5])
def test_intersection_percentage_and_view_repeatability_against_a_distance_matrix(eps: float) -> None:
    photo, view = _masks(0, density=0.1), _masks(1)
    ip = [np.mean(_slow_distances(p, v) <= eps) for p, v in zip(photo, view, strict=True)]
    rep = [np.mean(_slow_distances(v, p) <= eps) for p, v in zip(photo, view, strict=True)]
    np.testing.assert_allclose(metrics.intersection_percentage(photo, view, eps_px=eps), ip, rtol=1e-6)
    np.testing.assert_allclose(metrics.view_repeatability(view, photo, eps_px=eps), rep, rtol=1e-6)
    assert not np.allclose(ip, rep)


def test_repeatability_term_equals_intersection_percentage() -> None:
    photo, view = _masks(0, density=0.1), _masks(1)
    rep = repeatability(photo, dilate_points(view, 1.5)).diagonal()
    torch.testing.assert_close(rep, metrics.intersection_percentage(photo, view, eps_px=1.5))
    ours = metrics.view_repeatability(view, photo, eps_px=1.5)
    assert not np.allclose(ours, rep)


@pytest.mark.parametrize("percentile", [50.0, 95.0, 100.0])
def test_hausdorff_distance_percentile_and_direction(percentile: float) -> None:
    a, b = _masks(4, density=0.1), _masks(5)
    forward = [np.percentile(_slow_distances(x, y), percentile) for x, y in zip(a, b, strict=True)]
    backward = [np.percentile(_slow_distances(y, x), percentile) for x, y in zip(a, b, strict=True)]
    one_way = metrics.hausdorff_distance(a, b, percentile=percentile, directed=True)
    np.testing.assert_allclose(one_way, forward, rtol=1e-6)
    both = metrics.hausdorff_distance(a, b, percentile=percentile)
    np.testing.assert_allclose(both, np.maximum(forward, backward), rtol=1e-6)


def test_point_metrics_of_empty_masks() -> None:
    some, none = _masks(6, n=1)[0], torch.zeros(24, 31, dtype=torch.bool)
    assert float(metrics.intersection_percentage(some, none)) == 0.0
    assert math.isnan(float(metrics.intersection_percentage(none, some)))
    assert math.isnan(float(metrics.view_repeatability(none, some)))
    assert float(metrics.hausdorff_distance(some, none)) == float(metrics.hausdorff_distance(none, some)) == math.inf
    assert math.isnan(float(metrics.hausdorff_distance(none, none)))


def test_point_metrics_keep_leading_axes() -> None:
    a, b = _masks(7, n=6).view(3, 2, 24, 31), _masks(8, n=6).view(3, 2, 24, 31)
    together = metrics.hausdorff_distance(a, b)
    assert together.shape == (3, 2)
    assert float(together[2, 1]) == float(metrics.hausdorff_distance(a[2, 1], b[2, 1]))
    assert metrics.intersection_percentage(a[:0], b[:0]).shape == (0, 2)


def test_point_metrics_reject_bad_input() -> None:
    a = _masks(9)
    for call, match in (
        (lambda: metrics.intersection_percentage(a.float(), a), "photo: expected bool"),
        (lambda: metrics.intersection_percentage(a, a[:1]), r"view: expected bool of shape \(4, 24, 31\)"),
        (lambda: metrics.view_repeatability(a, a, eps_px=-1.0), "eps_px"),
        (lambda: metrics.hausdorff_distance(a, a, percentile=0.0), "percentile"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            call()
