import math
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch import ViewMatcher
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.terms import BoxShape, box_shape_score, box_shapes, whole_box_shapes


def test_box_shape_score_is_a_gaussian_of_the_log_aspect_ratio():
    views = torch.tensor([[0.0, 0, 20, 10], [0, 0, 10, 10], [0, 0, 10, 20]]) + 3.0
    score = box_shape_score(box_shapes(views[:1]), box_shapes(views), sigma=0.5)
    expected = [math.exp(-((k * math.log(2)) ** 2) / (2 * 0.5**2)) for k in (0, 1, 2)]
    assert score[0].tolist() == pytest.approx(expected, rel=1e-5)

    best = box_shape_score(torch.tensor([9.0]), torch.tensor([-1.0, 0.0, 1.0]))[0]
    assert best[2] == 1.0 > best[:2].max()


@pytest.mark.parametrize(
    ("box", "whole"),
    [
        ([10, 10, 60, 40], True),
        ([-0.5, 10, 60, 40], False),
        ([10, 10, 98.8, 40], False),
        ([10, 0, 60, 40], False),
        ([10, 10, 60, 99], False),
        ([-9, -9, 200, 200], False),
        # The border is 1 px and 1/100 of the longer side, 80 px: 1.8 px.
        ([1.4, 20, 81.4, 60], True),
        ([1.2, 20, 81.2, 60], False),
    ],
)
def test_whole_box_shapes_are_nan_at_the_border(box, whole):
    shape = whole_box_shapes(torch.tensor([box], dtype=torch.float32), [(80, 100)])
    assert bool(shape.isfinite()) == whole
    assert bool((box_shape_score(shape, torch.tensor([0.0, 3.0])) == 1).all()) != whole


def test_matcher_scores_the_whole_box(bank, photographs):
    images, boxes = photographs[0][:1], photographs[1][:1]
    matcher = ViewMatcher(bank)
    expected = box_shape_score(box_shapes(boxes), box_shapes(bank.boxes).float())
    torch.testing.assert_close(matcher(images, boxes).terms["box"], expected)
    H, W = images[0].shape[1:]
    assert bool((matcher(images, [[-0.5, -0.5, W - 0.5, H - 0.5]]).box == 1).all())
    assert bool((matcher.rank(matcher.features(matcher.query(images, boxes).crops)).terms["box"] == 1).all())


@pytest.mark.parametrize("shape", [math.nan, math.inf, -math.inf])
def test_box_shape_score_refuses_boxes_without_area(shape):
    with pytest.raises(InvalidInputError, match="views: expected finite shapes, got 1 of 3"):
        box_shape_score(torch.zeros(1), torch.tensor([0.0, shape, 0.5]))
    views = SimpleNamespace(boxes=torch.tensor([[0.0, 0, 20, 10], [math.nan] * 4]))
    with pytest.raises(InvalidInputError, match="views: expected finite shapes, got 1 of 2"):
        BoxShape().build(views)


@pytest.mark.parametrize(
    ("query", "sigma", "message"), [(math.inf, 0.2, "queries: expected finite"), (0.0, 0.0, "sigma")]
)
def test_box_shape_score_refuses_bad_queries_and_options(query, sigma, message):
    with pytest.raises(InvalidInputError, match=message):
        box_shape_score(torch.tensor([query]), torch.zeros(2), sigma=sigma)
