"""Correlation of descriptors, and whitening."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from sklearn.covariance import ledoit_wolf, ledoit_wolf_shrinkage

from curvireg_torch import ViewMatcher
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.terms import Correlation, DescriptorStatistics, Whitening, normalized_correlation, unit_score
from curvireg_torch.terms.correlation import CorrelationModule


def test_normalized_correlation_is_the_cosine():
    queries, views = torch.tensor([[3.0, 4.0], [1.0, 0.0]]), torch.tensor([[4.0, 3.0], [0.0, 2.0], [5.0, 12.0]])
    expected = torch.tensor([[24 / 25, 4 / 5, 63 / 65], [4 / 5, 0.0, 5 / 13]])
    torch.testing.assert_close(normalized_correlation(queries, views), expected)
    # Two crops of one photograph: the better one counts for each view.
    together = CorrelationModule(views)(SimpleNamespace(descriptors=queries[None]))
    torch.testing.assert_close(together, expected.amax(dim=0, keepdim=True))
    torch.testing.assert_close(CorrelationModule(views)(SimpleNamespace(descriptors=queries[:, None])), expected)


def test_unit_score_is_an_exponential_of_standard_deviations():
    """0, 0, 0 and 1 have a standard deviation of sqrt(3) / 4 (N in the denominator), so 0 is 4 / sqrt(3) below 1."""
    score = unit_score(torch.tensor([[0.0, 0.0, 0.0, 1.0], [3.0, 3.0, 3.0, 5.0]]))
    low = math.exp(-4.0 / math.sqrt(3.0))
    torch.testing.assert_close(score, torch.tensor([[low, low, low, 1.0]] * 2))


def sample(count: int, length: int = 12) -> torch.Tensor:
    generator = torch.Generator().manual_seed(count)
    mixing = torch.randn(length, length, generator=generator)
    return torch.randn(count, length, generator=generator) @ mixing + 3.0


@pytest.mark.parametrize("count", [5, 30, 2000])
def test_shrinkage_equals_scikit_learn(count):
    x = sample(count)
    statistics = DescriptorStatistics.from_descriptors(x)
    expected = ledoit_wolf_shrinkage(x.double().numpy())
    assert statistics.shrinkage("ledoit-wolf") == pytest.approx(expected, rel=1e-4)
    if count == 30:
        whitening = statistics.whitening(shrinkage="ledoit-wolf")
        precision = np.linalg.inv(ledoit_wolf(x.double().numpy())[0])
        np.testing.assert_allclose((whitening.matrix.T @ whitening.matrix).numpy(), precision, rtol=2e-3, atol=1e-5)


def test_whitening_without_shrinkage_decorrelates():
    x = sample(4000)
    white = DescriptorStatistics.from_descriptors(x).whitening(shrinkage=0.0)(x)
    torch.testing.assert_close(white.mean(dim=0), torch.zeros(12), atol=1e-3, rtol=0)
    torch.testing.assert_close(white.T @ white / len(white), torch.eye(12), atol=1e-2, rtol=0)


def test_whitening_with_full_shrinkage_centres_and_scales():
    x = sample(30)
    statistics = DescriptorStatistics.from_descriptors(x)
    scale = float(statistics.covariance.diagonal().mean()) ** 0.5
    torch.testing.assert_close(statistics.whitening(shrinkage=1.0)(x), (x - statistics.mean) / scale)
    assert torch.equal(statistics.whitening()(x), statistics.whitening(shrinkage=0.5)(x))
    assert not torch.allclose(statistics.whitening()(x), statistics.whitening(shrinkage=1.0)(x))


def test_whitening_refuses_unusable_statistics():
    assert DescriptorStatistics.from_descriptors(torch.ones(4, 3)).shrinkage("ledoit-wolf") == 1.0
    few = DescriptorStatistics.from_descriptors(sample(5))
    for call, message in (
        (lambda: few.whitening(shrinkage=0.0), "positive definite"),
        (lambda: few.shrinkage(1.5), "shrinkage"),
        (lambda: few.shrinkage("oas"), "shrinkage"),
        (lambda: DescriptorStatistics.from_descriptors(torch.ones(1, 3)), "at least 2"),
        (lambda: Whitening(torch.zeros(3), torch.eye(2)), "covariance"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            call()


def test_matcher_ranks_by_whitened_correlation(bank, photographs):
    assert Correlation().build(bank).whitening is None
    assert Correlation(whitening="bank").build(bank).whitening is not None
    images, boxes = photographs[0][:1], photographs[1][:1]
    whitening = DescriptorStatistics.from_descriptors(bank.descriptors).whitening()
    matcher = ViewMatcher(bank, box_jitter=0.0, whitening=whitening)
    query = matcher.query(images, boxes).descriptors[:, 0]
    factor = torch.linalg.inv(whitening.matrix)
    a, b = (torch.linalg.solve(factor, (x - whitening.mean).T).T for x in (query, bank.descriptors))
    expected = F.cosine_similarity(a[:, None], b[None], dim=2)
    torch.testing.assert_close(matcher(images, boxes).hog, expected, atol=1e-4, rtol=1e-3)
