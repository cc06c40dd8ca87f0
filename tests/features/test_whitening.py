import numpy as np
import pytest
import sklearn.covariance
import torch
from torch.testing import assert_close

from curvireg_torch.features.whitening import Precision, Whitening, ledoit_wolf
from tests._support import refused, seeded


def sample(count, length=12):
    generator = seeded(count)
    mixing = torch.randn(length, length, generator=generator)
    return torch.randn(count, length, generator=generator) @ mixing + 3.0


@pytest.mark.parametrize("count", [5, 30, 2000])
def test_ledoit_wolf_equals_scikit_learn(count):
    x = sample(count)
    mean, covariance = ledoit_wolf(x)
    expected = sklearn.covariance.ledoit_wolf(x.double().numpy())[0]
    np.testing.assert_allclose(covariance.numpy(), expected, rtol=1e-3, atol=1e-4)
    assert_close(mean, x.mean(dim=0))


@pytest.mark.parametrize("count", [5, 30, 2000])
def test_precision_solves_with_the_shrunk_covariance(count):
    x = sample(count, 24)
    y = sample(7, 24)
    mean, covariance = ledoit_wolf(x)
    precision = Precision(x)
    assert_close(precision.mean, mean)
    expected = torch.linalg.solve(covariance.double(), y.double().T).T.float()
    assert_close(precision(y), expected, rtol=2e-3, atol=1e-4)
    with refused("look alike"):
        Precision(torch.ones(count, 24))


def test_whitening_refuses_covariances_that_cannot_be_inverted():
    x = sample(5)
    with refused("positive definite"):
        Whitening(x.mean(dim=0), x.T.cov())
    with refused("covariance"):
        Whitening(torch.zeros(3), torch.eye(2))
    with refused("mean: expected finite"):
        Whitening(torch.full((2,), torch.nan), torch.eye(2))
    with refused("covariance: expected finite"):
        Whitening(torch.zeros(2), torch.full((2, 2), torch.nan))
    with refused("symmetric"):
        Whitening(torch.zeros(2), torch.tensor([[1.0, 0.5], [0.0, 1.0]]))
    with refused(r"descriptors: expected shape \(\*, 2\)"):
        Whitening(torch.zeros(2), torch.eye(2))(torch.ones(3, 5))
