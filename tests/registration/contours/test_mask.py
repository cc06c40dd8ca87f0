"""Weights of edges by the side on which the object lies."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from curvireg_torch import LearnedCurvilinearSaliency, MultiScaleFocusCurves
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.registration.contours.mask import ObjectMask
from curvireg_torch.registration.contours.points import ContourPoints
from curvireg_torch.registration.estimator import PoseEstimator
from tests.registration.contours.common import CUBE_POSE, cube, fitted, silhouette
from tests.registration.contours.test_descent import T, problem, state


def half_planes(*columns: int) -> ObjectMask:
    """For each column a crop of 256 px with the object to its left."""
    x = torch.arange(256)
    return ObjectMask(torch.stack([(x < column).float().expand(1, 256, 256) for column in columns]))


def row_of_points(outline: bool, direction: float, *, count: int = 1) -> ContourPoints:
    normals = torch.tensor([direction, 0.0], dtype=torch.float64).expand(count, 1, 2)
    there = torch.ones(count, 1, dtype=torch.bool)
    return ContourPoints(torch.zeros(count, 1, 3, dtype=torch.float64), normals, there, there & outline)


@pytest.mark.parametrize(
    ("outline", "direction", "expected"),
    [
        (True, 1.0, [0.6, 2.0, 0.6]),
        (True, -1.0, [0.6, 0.6, 0.6]),  # the object lies outside
        (False, 1.0, [1.0, 0.3, 0.3]),
        (False, -1.0, [0.3, 0.3, 1.0]),
    ],
)
def test_weights_within_at_the_border_and_beyond(outline, direction, expected):
    """At 20 px to the left of the border, on it, and at 20 px to the right."""
    uv = torch.tensor([[[127.5, 90.0]]], dtype=torch.float64)
    offsets = torch.tensor([-20.0, 0.0, 20.0], dtype=torch.float64)
    weights = half_planes(128).weights(uv, row_of_points(outline, direction), offsets, torch.tensor([0]), 256)
    assert weights[0, 0].tolist() == pytest.approx(expected)


def test_weights_of_partial_probabilities():
    mask = ObjectMask(0.8 * half_planes(128)._probability + 0.1)
    uv = torch.tensor([[[127.5, 90.0]]], dtype=torch.float64)
    at = torch.zeros(1, dtype=torch.float64)
    first = torch.tensor([0])
    assert float(mask.weights(uv, row_of_points(True, 1.0), at, first, 256)) == pytest.approx(2 * (0.3 + 0.7 * 0.8))
    assert float(mask.weights(uv, row_of_points(False, 1.0), at, first, 256)) == pytest.approx(0.3 + 0.7 * 0.1)


def test_each_pose_has_the_mask_of_its_crop_at_any_size():
    """Borders at 128 and 64 of 256 px are at 64 and 32 of 128 px; the mask is read 3 px to both sides there."""
    uv = torch.tensor([[[31.5, 50.0]], [[63.5, 50.0]], [[31.5, 50.0]]], dtype=torch.float64)
    at, index = torch.zeros(1, dtype=torch.float64), torch.tensor([0, 0, 1])
    found = half_planes(128, 64).weights(uv, row_of_points(True, 1.0, count=3), at, index, 128)
    assert found.flatten().tolist() == pytest.approx([0.6, 2.0, 2.0])
    off = torch.tensor([-2.4, 2.4, -3.6, 3.6], dtype=torch.float64)
    found = half_planes(128).weights(uv[1:2], row_of_points(True, 1.0), off, torch.tensor([0]), 128)
    assert found.flatten().tolist() == pytest.approx([2.0, 2.0, 0.6, 0.6])


def test_steps_and_comparison_weight_edges_and_reports_do_not():
    """For two points of three the edge at 3 px is wrong; the mask gives it a tenth of the weight of the others."""
    wrong = torch.arange(120) % 3 > 0
    distances = torch.where(wrong, 3.0, 0.0).double()[None]
    plain = problem(distances, [0.6])
    weights = torch.where(wrong, 0.1, 1.5).double()[None]
    mask: Any = SimpleNamespace(weights=lambda *_: weights[..., None], largest_weights=lambda _: 2.0 * weights)
    weighted = replace(plain, mask=mask)
    points = state(120)
    steps = [torch.linalg.vector_norm(one._solve(points.points, T, 6.0, None)[0]) for one in (plain, weighted)]
    assert float(steps[1]) < 0.2 * float(steps[0])
    torch.testing.assert_close(weighted.matches(points, 4.0).weight, plain.matches(points, 4.0).weight)
    assert float(weighted.edge_support(points)) == float(plain.edge_support(points))
    # Of the edges at 3 px, the flank at 2 px counts most.
    by_hand = 0.6 * (40 * 1.5 + 80 * 0.1 * (1 - 1 / 2.25) * math.exp(-2.0)) / (2 * (40 * 1.5 + 80 * 0.1))
    assert float(weighted.supports(points)[1]) == pytest.approx(by_hand)
    assert float(plain.supports(points)[1]) == float(plain.edge_support(points))


def test_mask_of_another_number_of_photographs_is_refused():
    image = silhouette(cube(), CUBE_POSE)
    with pytest.raises(InvalidInputError, match="object_mask"):
        fitted(image, CUBE_POSE[None], object_mask=torch.ones(2, 1, 8, 8))


def test_only_the_learned_field_has_a_mask():
    crops = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    estimator, query = object.__new__(PoseEstimator), SimpleNamespace(crops=crops)
    learned: Any = LearnedCurvilinearSaliency()
    alone = torch.cat([learned.mask(crops[:1]), learned.mask(crops[1:])])  # batches round differently
    for field, expected in ((learned, alone), (MultiScaleFocusCurves(), None)):
        estimator.matcher = SimpleNamespace(field=field)
        mask = estimator.object_mask(query)
        assert mask is None if expected is None else torch.equal(mask, expected)
