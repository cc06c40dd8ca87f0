"""Correlation of descriptors, and whitening."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import sklearn.covariance
import torch
import torch.nn.functional as F

from curvireg_torch import ViewMatcher
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.terms import Correlation, Whitening, ledoit_wolf, normalized_correlation, unit_score
from curvireg_torch.terms.terms import _CorrelationModule


def test_normalized_correlation_is_the_cosine():
    queries, views = torch.tensor([[3.0, 4.0], [1.0, 0.0]]), torch.tensor([[4.0, 3.0], [0.0, 2.0], [5.0, 12.0]])
    expected = torch.tensor([[24 / 25, 4 / 5, 63 / 65], [4 / 5, 0.0, 5 / 13]])
    torch.testing.assert_close(normalized_correlation(queries, views), expected)
    # Two crops of one photograph: the better one counts for each view.
    together = _CorrelationModule(views)(SimpleNamespace(descriptors=queries[None]))
    torch.testing.assert_close(together, expected.amax(dim=0, keepdim=True))
    torch.testing.assert_close(_CorrelationModule(views)(SimpleNamespace(descriptors=queries[:, None])), expected)


def test_unit_score_is_an_exponential_of_standard_deviations():
    score = unit_score(torch.tensor([[0.0, 0.0, 0.0, 1.0], [3.0, 3.0, 3.0, 5.0]]))
    low = math.exp(-4.0 / math.sqrt(3.0))  # the standard deviation of 0, 0, 0, 1 is sqrt(3) / 4
    torch.testing.assert_close(score, torch.tensor([[low, low, low, 1.0]] * 2))


def sample(count: int, length: int = 12) -> torch.Tensor:
    generator = torch.Generator().manual_seed(count)
    mixing = torch.randn(length, length, generator=generator)
    return torch.randn(count, length, generator=generator) @ mixing + 3.0


@pytest.mark.parametrize("count", [5, 30, 2000])
def test_ledoit_wolf_equals_scikit_learn(count):
    x = sample(count)
    mean, covariance = ledoit_wolf(x)
    expected = sklearn.covariance.ledoit_wolf(x.double().numpy())[0]
    np.testing.assert_allclose(covariance.numpy(), expected, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(mean, x.mean(dim=0))


def test_whitening_decorrelates():
    x = sample(4000)
    white = Whitening(x.mean(dim=0), x.T.cov(correction=0))(x)
    torch.testing.assert_close(white.mean(dim=0), torch.zeros(12), atol=1e-3, rtol=0)
    torch.testing.assert_close(white.T @ white / len(white), torch.eye(12), atol=1e-2, rtol=0)
    with pytest.raises(InvalidInputError, match="positive definite"):
        Whitening(x[:5].mean(dim=0), x[:5].T.cov())
    with pytest.raises(InvalidInputError, match="covariance"):
        Whitening(torch.zeros(3), torch.eye(2))


def test_ledoit_wolf_of_degenerate_samples():
    """All shrinkage, because equal descriptors have no covariance; and no shrinkage is below 0."""
    two = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]])
    mean, covariance = ledoit_wolf(two)
    assert torch.equal(mean, torch.zeros(3))
    expected = sklearn.covariance.ledoit_wolf(two.numpy())[0]
    np.testing.assert_allclose(covariance.numpy(), expected, rtol=1e-5)
    assert torch.equal(ledoit_wolf(torch.ones(4, 3))[1], torch.zeros(3, 3))
    with pytest.raises(InvalidInputError, match="at least 2"):
        ledoit_wolf(torch.ones(1, 3))


def test_matcher_ranks_by_whitened_correlation(bank, photographs):
    assert Correlation().build(bank).whitening is None
    images, boxes = photographs[0][:1], photographs[1][:1]
    pipeline = replace(bank.pipeline.with_term("hog", whitening="bank"), box_jitter=0.0)
    matcher = ViewMatcher(bank, pipeline=pipeline)
    query = matcher.query(images, boxes).descriptors[:, 0]
    mean, covariance = ledoit_wolf(bank.descriptors)
    factor = torch.linalg.cholesky(covariance.double())
    a, b = (torch.linalg.solve(factor, (x - mean).double().T).T for x in (query, bank.descriptors))
    expected = F.cosine_similarity(a[:, None], b[None], dim=2).float()
    torch.testing.assert_close(matcher(images, boxes).hog, expected, atol=1e-4, rtol=1e-3)
