"""K-medoids of a bank's views."""

import copy

import pytest
import torch

from curvireg_torch import ViewBank
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.registration.locator import representative_views, representatives
from curvireg_torch.registration.locator.representatives import _medoids, nearest_representatives
from tests._support.scenes import truck_bank


def squared_distances(points: torch.Tensor) -> torch.Tensor:
    return (points[:, None] - points).square()


def bank_of_ratios(ratios: torch.Tensor) -> ViewBank:
    """A bank whose views differ in the aspect ratio (width / height) of their boxes only."""
    bank = copy.copy(truck_bank())
    bank.descriptors = torch.ones_like(bank.descriptors)
    corner = torch.stack([ratios, torch.ones_like(ratios)], dim=1)
    bank.boxes = torch.cat([-corner, corner], dim=1)
    return bank


def test_medoids_are_the_centres_of_clusters() -> None:
    points = torch.tensor([0.0, 0.1, 0.2, 5.0, 5.1, 5.2, 9.0, 9.1, 9.2])[torch.randperm(9)]
    assert sorted(points[_medoids(squared_distances(points), 3)].tolist()) == pytest.approx([0.1, 5.1, 9.1])


def test_medoids_are_better_than_random_choices() -> None:
    points = torch.randn(300, 4, generator=torch.Generator().manual_seed(0))
    distances = torch.cdist(points, points).square()
    cost = distances[:, _medoids(distances, 12)].amin(dim=1).sum()
    generator = torch.Generator().manual_seed(1)
    random = [distances[:, torch.randperm(300, generator=generator)[:12]].amin(dim=1).sum() for _ in range(20)]
    assert cost < 0.9 * min(random)


def test_medoids_of_duplicates_are_different_points() -> None:
    points = torch.tensor([0.0, 0.0, 2.0])
    assert sorted(_medoids(squared_distances(points), 2).tolist()) in ([0, 2], [1, 2])


def test_medoids_start_at_the_centre_and_continue_with_the_farthest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(representatives, "ROUNDS", 0)
    points = torch.tensor([1.0, 0.0, 3.0, 10.0, 2.0])
    assert points[_medoids(squared_distances(points), 3)].tolist() == [3.0, 10.0, 0.0]


def test_representative_views_of_each_model() -> None:
    bank = ViewBank.join([truck_bank(), truck_bank()])
    views = representative_views(bank, 7)
    assert torch.equal(views, views.unique())
    assert bank.model[views].bincount().tolist() == [7, 7]
    assert len(representative_views(truck_bank(), 10_000)) == len(truck_bank()), "all of a smaller bank"
    with pytest.raises(InvalidInputError, match="count: expected >= 1, got 0"):
        representative_views(bank, 0)


def test_representative_views_differ_by_logarithms_of_aspect_ratios() -> None:
    """Ratios of 1:8 differ more from squares than ratios of 3:1 do."""
    n, dtype = len(truck_bank()), truck_bank().boxes.dtype
    two = torch.where(torch.arange(n) < 5, 0.5, 2.0).to(dtype)
    assert (representative_views(bank_of_ratios(two), 2) < 5).tolist() == [True, False]
    three = torch.ones(n, dtype=dtype)
    three[:2], three[2:12] = 1.0 / 8.0, 3.0
    assert sorted(three[representative_views(bank_of_ratios(three), 2)].tolist()) == [0.125, 1.0]


def test_nearest_representatives_are_the_most_similar_of_the_same_model() -> None:
    bank = ViewBank.join([truck_bank(), truck_bank()])
    n, chosen = len(truck_bank()), representative_views(bank, 7)
    nearest = nearest_representatives(bank, chosen)
    assert torch.equal(nearest[chosen], torch.arange(14))
    assert torch.equal(bank.model[chosen[nearest]], bank.model)
    assert torch.equal(nearest[:n] + 7, nearest[n:])


def test_nearest_representatives_compare_descriptors_and_ratios() -> None:
    bank = bank_of_ratios(torch.linspace(0.5, 2.0, len(truck_bank()), dtype=torch.float64))
    n = len(bank)
    assert nearest_representatives(bank, torch.tensor([0, n - 1])).diff().tolist().index(1) + 1 == pytest.approx(
        n / 3, abs=1
    )
