import math
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch import ViewMatcher
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.terms import BoxShape, box_shape_score, box_shapes, whole_box_shapes
from tests._support.scenes import scene, truck_bank


def test_the_score_is_a_gaussian_of_the_log_ratio_of_proportions():
    views = torch.tensor([[0.0, 0, 20, 10], [0, 0, 10, 10], [0, 0, 10, 20]])
    score = box_shape_score(box_shapes(views[:1]), box_shapes(views), sigma=0.5)
    expected = [math.exp(-((k * math.log(2)) ** 2) / (2 * 0.5**2)) for k in (0, 1, 2)]
    assert score[0].tolist() == pytest.approx(expected, rel=1e-5)


def test_the_best_view_scores_1_however_odd_the_box():
    score = box_shape_score(torch.tensor([9.0]), torch.tensor([-1.0, 0.0, 1.0]))
    assert score[0, 2] == 1.0
    assert bool((score[0, :2] < 1.0).all())


def test_size_and_place_do_not_matter():
    box = torch.tensor([3.0, 4, 33, 14])
    assert float(box_shapes(box)) == pytest.approx(float(box_shapes(5 * box + 100)), abs=1e-6)


@pytest.mark.parametrize(
    ("box", "known"),
    [
        ([10, 10, 60, 40], True),
        ([-0.5, 10, 60, 40], False),
        ([10, 10, 98.8, 40], False),
        ([10, 0, 60, 40], False),
        ([10, 10, 60, 99], False),
        ([-9, -9, 200, 200], False),
    ],
)
def test_a_box_at_the_border_says_nothing_of_the_shape(box, known):
    shape = whole_box_shapes(torch.tensor([box], dtype=torch.float32), [(80, 100)] * 1)
    assert bool(shape.isfinite()) == known
    assert bool((box_shape_score(shape, torch.tensor([0.0, 3.0])) == 1).all()) != known


def test_the_matcher_weighs_views_by_the_shape_of_the_whole_box():
    image, box, _ = scene(0)
    matcher = ViewMatcher(truck_bank())
    ranking = matcher([image], box[None])
    expected = box_shape_score(box_shapes(box[None]), box_shapes(truck_bank().boxes).float())
    torch.testing.assert_close(ranking.box, expected)
    whole = torch.tensor([[-0.5, -0.5, image.shape[2] - 0.5, image.shape[1] - 0.5]])
    assert bool((matcher([image], whole).box == 1).all())
    assert bool((matcher.rank(matcher.features(matcher.crop([image], box[None])[0])).box == 1).all())


def test_bad_options_are_named():
    with pytest.raises(InvalidInputError, match="sigma"):
        box_shape_score(torch.zeros(1), torch.zeros(1), sigma=0.0)


@pytest.mark.parametrize("shape", [math.nan, math.inf, -math.inf])
def test_shapes_of_boxes_without_area_are_refused(shape):
    """They would score 1 or turn every score into NaN."""
    with pytest.raises(InvalidInputError, match="views: expected finite shapes, got 1 of 3"):
        box_shape_score(torch.zeros(1), torch.tensor([0.0, shape, 0.5]))
    if math.isinf(shape):
        with pytest.raises(InvalidInputError, match="queries: expected finite shapes"):
            box_shape_score(torch.tensor([0.0, shape]), torch.zeros(2))


def test_a_bank_with_a_view_without_box_makes_no_matcher():
    views = SimpleNamespace(boxes=torch.tensor([[0.0, 0, 20, 10], [math.nan] * 4]))
    with pytest.raises(InvalidInputError, match="views: expected finite shapes, got 1 of 2"):
        BoxShape().build(views)
