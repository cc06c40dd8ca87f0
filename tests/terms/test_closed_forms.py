"""What terms compare, in numbers worked out by hand."""

import math
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.terms import (
    BoxShape,
    Correlation,
    Repeatability,
    dilate_points,
    jittered_boxes,
    normalized_correlation,
    repeatability,
    repeatability_score,
    whole_box_shapes,
)
from curvireg_torch.terms.correlation import CorrelationModule, unit_score
from curvireg_torch.terms.whitening import DescriptorStatistics


def test_correlation_is_the_cosine_of_each_query_with_each_view():
    queries, views = torch.tensor([[3.0, 4.0], [1.0, 0.0]]), torch.tensor([[4.0, 3.0], [0.0, 2.0], [5.0, 12.0]])
    expected = torch.tensor([[24 / 25, 4 / 5, 63 / 65], [4 / 5, 0.0, 5 / 13]])
    torch.testing.assert_close(normalized_correlation(queries, views), expected)
    # Of the crops of a photograph the best counts, view by view: both are crops of one, then each of its own.
    together = CorrelationModule(views)(SimpleNamespace(descriptors=queries[None]))
    torch.testing.assert_close(together, expected.amax(dim=0, keepdim=True))
    torch.testing.assert_close(CorrelationModule(views)(SimpleNamespace(descriptors=queries[:, None])), expected)


def test_whitening_is_asked_for_by_name_and_shrinks_by_half():
    descriptors = torch.rand(40, 6, generator=torch.Generator().manual_seed(0))
    views = SimpleNamespace(descriptors=descriptors)
    assert Correlation().build(views).whitening is None
    assert Correlation(whitening="bank").build(views).whitening is not None
    statistics = DescriptorStatistics.from_descriptors(descriptors)
    x = descriptors[:3]
    assert torch.equal(statistics.whitening()(x), statistics.whitening(shrinkage=0.5)(x))
    assert not torch.allclose(statistics.whitening()(x), statistics.whitening(shrinkage=1.0)(x))


def test_points_are_dilated_by_a_disc():
    points = torch.zeros(1, 9, 9, dtype=torch.bool)
    points[0, 4, 4] = True
    y, x = torch.meshgrid(*[torch.arange(9) - 4] * 2, indexing="ij")
    for eps in (1.0, 2.0, 2.9, 3.0):
        assert dilate_points(points, eps)[0].equal(x**2 + y**2 <= eps**2)


def test_repeatability_is_a_share_of_each_querys_points():
    queries = torch.zeros(2, 4, 4, dtype=torch.bool)
    queries[0, 0, :4] = queries[1, 3, :2] = True
    views = torch.zeros(2, 4, 4, dtype=torch.bool)
    views[0, 0, 0] = views[1, 3] = views[1, 0, :2] = True
    assert repeatability(queries, views).tolist() == [[0.25, 0.5], [0.0, 1.0]]
    score = repeatability_score(torch.tensor([[0.9, 0.7]]), sigma=0.2)[0]
    torch.testing.assert_close(score, torch.tensor([1.0, math.exp(-0.5)]))


def test_a_box_reaches_the_border_within_a_hundredth_of_its_side():
    """1 px and 1/100 of the longer side, 100 px: 2 px."""
    inside = torch.tensor([1.6, 20.0, 101.6, 70.0])
    beside = inside - torch.tensor([0.2, 0.0, 0.2, 0.0])
    shapes = whole_box_shapes(torch.stack([inside, beside]), [(100, 200)] * 2)
    assert shapes[0] == pytest.approx(math.log(2.0), abs=1e-6)
    assert shapes[1].isnan()


@pytest.mark.parametrize("term", [Correlation, Repeatability, BoxShape])
def test_weights_are_checked_in_every_term(term):
    with pytest.raises(InvalidInputError, match="weight"):
        term(weight=-1.0)


def test_slack_is_at_most_nearly_half():
    box = torch.tensor([[0.0, 0.0, 100.0, 50.0]])
    assert jittered_boxes(box, 0.45).shape == (1, 7, 4)
    with pytest.raises(InvalidInputError, match="box_jitter"):
        jittered_boxes(box, 0.46)


def test_the_score_of_a_correlation_is_an_exponential_of_standard_deviations():
    """0, 0, 0 and 1 have a standard deviation of sqrt(3) / 4 (N in the denominator); 0 lies 4 / sqrt(3) below 1."""
    score = unit_score(torch.tensor([[0.0, 0.0, 0.0, 1.0], [3.0, 3.0, 3.0, 5.0]]))
    low = math.exp(-4.0 / math.sqrt(3.0))
    torch.testing.assert_close(score, torch.tensor([[low, low, low, 1.0]] * 2))
