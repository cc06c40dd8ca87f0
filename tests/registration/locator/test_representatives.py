"""K-medoids of a bank's views."""

import pytest
import torch

from curvireg_torch import ViewBank
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.registration.locator import representative_views, representatives
from curvireg_torch.registration.locator.representatives import _medoids
from tests._support.scenes import truck_bank


def test_medoids_are_the_middles_of_clusters() -> None:
    """Three tight groups on a line: their middle points, whatever the order."""
    places = torch.tensor([0.0, 0.1, 0.2, 5.0, 5.1, 5.2, 9.0, 9.1, 9.2])[torch.randperm(9)]
    apart = (places[:, None] - places).square()
    assert sorted(places[_medoids(apart, 3)].tolist()) == pytest.approx([0.1, 5.1, 9.1])


def test_medoids_lie_nearer_to_all_views_than_as_many_taken_at_random() -> None:
    points = torch.randn(300, 4, generator=torch.Generator().manual_seed(0))
    apart = torch.cdist(points, points).square()
    cost = apart[:, _medoids(apart, 12)].amin(dim=1).sum()
    generator = torch.Generator().manual_seed(1)
    chance = [apart[:, torch.randperm(300, generator=generator)[:12]].amin(dim=1).sum() for _ in range(20)]
    assert cost < 0.9 * min(chance)


def test_twins_do_not_make_two_medoids_of_one() -> None:
    apart = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 4.0], [4.0, 4.0, 0.0]])
    assert sorted(_medoids(apart, 2).tolist()) in ([0, 2], [1, 2])


def test_each_model_has_its_own() -> None:
    bank = ViewBank.join([truck_bank(), truck_bank()])
    views = representative_views(bank, 7)
    assert torch.equal(views, views.unique())
    assert bank.model[views].bincount().tolist() == [7, 7]
    assert len(representative_views(truck_bank(), 10_000)) == len(truck_bank()), "all of a smaller bank"
    with pytest.raises(InvalidInputError, match="count: expected >= 1, got 0"):
        representative_views(bank, 0)


def test_boxes_count_beside_descriptors() -> None:
    """Views with one descriptor and two shapes of boxes: both shapes are represented."""
    bank = truck_bank()
    plain = bank.__class__.__new__(bank.__class__)
    plain.__dict__.update(bank.__dict__)
    plain.descriptors = torch.ones_like(bank.descriptors)
    wide = torch.tensor([-2.0, -1.0, 2.0, 1.0], dtype=bank.boxes.dtype)
    tall = torch.tensor([-1.0, -2.0, 1.0, 2.0], dtype=bank.boxes.dtype)
    plain.boxes = torch.where((torch.arange(len(bank)) < 5)[:, None], tall, wide)
    views = representative_views(plain, 2)
    assert (views < 5).tolist() == [True, False]


def test_the_most_central_view_starts_and_the_farthest_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(representatives, "ROUNDS", 0)
    places = torch.tensor([1.0, 0.0, 3.0, 10.0, 2.0])
    apart = (places[:, None] - places).square()
    assert places[_medoids(apart, 3)].tolist() == [3.0, 10.0, 0.0]


def test_proportions_of_boxes_differ_by_their_logarithms() -> None:
    """Boxes 8 times as tall as wide differ more from squares than boxes 3 times as wide as tall do."""
    bank = truck_bank()
    plain = bank.__class__.__new__(bank.__class__)
    plain.__dict__.update(bank.__dict__)
    plain.descriptors = torch.ones_like(bank.descriptors)
    proportion = torch.ones(len(bank), dtype=bank.boxes.dtype)
    proportion[:2], proportion[2:12] = 1.0 / 8.0, 3.0
    corner = torch.stack([proportion, torch.ones_like(proportion)], dim=1)
    plain.boxes = torch.cat([-corner, corner], dim=1)
    assert sorted(proportion[representative_views(plain, 2)].tolist()) == [0.125, 1.0]
