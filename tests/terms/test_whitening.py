import numpy as np
import pytest
import torch
from sklearn.covariance import ledoit_wolf, ledoit_wolf_shrinkage

from curvireg_torch import ViewMatcher
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.terms import DescriptorStatistics, Whitening
from tests._support.scenes import scene, truck_bank


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


def test_shrunk_covariance_is_that_of_scikit_learn():
    x = sample(30)
    whitening = DescriptorStatistics.from_descriptors(x).whitening(shrinkage="ledoit-wolf")
    expected = np.linalg.inv(ledoit_wolf(x.double().numpy())[0])
    np.testing.assert_allclose((whitening.matrix.T @ whitening.matrix).numpy(), expected, rtol=2e-3, atol=1e-5)


def test_whitened_samples_have_no_correlation():
    x = sample(4000)
    white = DescriptorStatistics.from_descriptors(x).whitening(shrinkage=0.0)(x)
    torch.testing.assert_close(white.mean(dim=0), torch.zeros(12), atol=1e-3, rtol=0)
    torch.testing.assert_close(white.T @ white / len(white), torch.eye(12), atol=1e-2, rtol=0)


def test_equal_descriptors_shrink_to_the_identity_and_too_little_shrinkage_is_named():
    same = DescriptorStatistics.from_descriptors(torch.ones(4, 3))
    assert same.shrinkage("ledoit-wolf") == 1.0
    few = DescriptorStatistics.from_descriptors(sample(5))
    with pytest.raises(InvalidInputError, match="positive definite"):
        few.whitening(shrinkage=0.0)
    with pytest.raises(InvalidInputError, match="shrinkage"):
        few.shrinkage(1.5)
    with pytest.raises(InvalidInputError, match="shrinkage"):
        few.shrinkage("oas")
    with pytest.raises(InvalidInputError, match="at least 2"):
        DescriptorStatistics.from_descriptors(torch.ones(1, 3))


def test_the_matcher_ranks_by_whitened_correlation():
    bank = truck_bank()
    whitening = DescriptorStatistics.from_descriptors(bank.descriptors).whitening()
    image, box, _ = scene(0)
    matcher = ViewMatcher(bank, box_jitter=0.0, whitening=whitening)
    query = matcher.query([image], box[None]).descriptors[:, 0]
    a, b = (torch.linalg.solve(torch.linalg.inv(whitening.matrix), (x - whitening.mean).T).T for x in
            (query, bank.descriptors))  # fmt: skip
    expected = torch.nn.functional.cosine_similarity(a[:, None], b[None], dim=2)
    torch.testing.assert_close(matcher([image], box[None]).hog, expected, atol=1e-4, rtol=1e-3)


def test_complete_whitening_by_the_identity_is_centred_correlation():
    bank = truck_bank()
    statistics = DescriptorStatistics.from_descriptors(bank.descriptors)
    centred = statistics.whitening(shrinkage=1.0)
    x = bank.descriptors[:3]
    scale = float(statistics.covariance.diagonal().mean()) ** 0.5
    torch.testing.assert_close(centred(x), (x - statistics.mean) / scale)


def test_a_covariance_of_another_size_is_named():
    with pytest.raises(InvalidInputError, match="covariance"):
        Whitening(torch.zeros(3), torch.eye(2))
