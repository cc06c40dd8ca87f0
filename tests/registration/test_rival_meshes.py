"""Several meshes that may be the object: rivals, of which none is believed where two fit."""

from dataclasses import fields, replace
from functools import cache
from unittest.mock import Mock

import pytest
import torch
import trimesh

from curvireg_torch import Registrar
from curvireg_torch.errors import LostObjectError
from curvireg_torch.evidence import Evidence
from curvireg_torch.fitting.details import ContourDetails
from curvireg_torch.registration import FailedRegistration, judging, stages
from curvireg_torch.registration.judging import best_of_meshes, joined
from tests._support import (
    answer_of,
    bank_around,
    learned_registrar,
    photograph_of,
    scene,
    slow_after,
    truck_answer,
    truck_bank,
)
from tests._support.results import registration


@cache
def truck(*, with_cabin=True):
    parts = [
        trimesh.creation.box((200, 90, 50)),
        trimesh.creation.box((20, 30, 30)).apply_translation((90, 20, 40)),
    ]
    if with_cabin:
        parts.append(trimesh.creation.box((50, 80, 60)).apply_translation((-60, 0, 55)))
    return trimesh.util.concatenate(parts)


@cache
def bank(*, with_cabin=True, scale=1.0):
    return bank_around(truck(with_cabin=with_cabin).copy().apply_scale(scale), 30, [10, 40])


def registered(shown, *banks):
    image, box, _ = photograph_of(shown, 35.0, 25.0, 0)
    pipeline = learned_registrar().pipeline  # photographs are registered once
    return answer_of(Registrar(list(banks), pipeline=pipeline), image, box)


@pytest.mark.slow
@pytest.mark.parametrize("order", [-1, 1])
def test_one_shape_in_two_sizes_is_named_and_not_reliable(order):
    result = registered(truck(), *(bank(), bank(scale=1.2))[::order])
    assert not result.reliable
    assert result.ambiguous == "mesh 0 or 1"
    assert sum(result.mesh_probabilities) > 0.9
    assert result.no_match_probability < 0.1
    assert result.to_dict()["mesh_probabilities"] == list(result.mesh_probabilities)


@pytest.mark.parametrize(
    ("with_cabin", "order"), slow_after(1, [(False, -1), (True, -1), (False, 1), (True, 1)])
)
def test_a_variant_with_a_part_more_is_told_from_that_without(with_cabin, order):
    banks = (bank(with_cabin=True), bank(with_cabin=False))[::order]
    result = registered(truck(with_cabin=with_cabin), *banks)
    assert banks[result.mesh_index] is bank(with_cabin=with_cabin)
    assert result.ambiguous is None


def result_of(similarity, confidence):
    made = registration(confidence=confidence)
    nothing = dict.fromkeys((field.name for field in fields(Evidence)), 0.0)
    hypotheses = tuple(
        replace(hypothesis, evidence={**nothing, "similarity": value})
        for hypothesis, value in zip(made.hypotheses, (similarity, 0.1), strict=True)
    )
    return replace(made, hypotheses=hypotheses)


def best(*results):
    return best_of_meshes(results, [learned_registrar()] * len(results))


def test_the_mesh_with_the_higher_score_is_the_answer_and_keeps_its_confidence():
    results = [result_of(0.2, 0.4), result_of(0.8, 0.9)]
    for order, index in ((1, 1), (-1, 0)):
        found = best(*results[::order])
        assert found.mesh_index == index
        assert found.confidence == pytest.approx(0.9, abs=0.01)
        assert found.ambiguous is None


def test_meshes_with_near_scores_are_compared_in_detail(monkeypatch):
    """The second is 1 behind the first by its score, and 4 ahead in detail; the third is 7
    behind."""
    results = [result_of(similarity, 0.9) for similarity in (0.8, 0.7, 0.1)]
    first = replace(results[0].hypotheses[0], edge_support=0.5)
    results[0] = replace(results[0], hypotheses=(first, *results[0].hypotheses[1:]))
    seen = []
    gain = torch.tensor([[0.0, -4.0], [4.0, 0.0]])
    monkeypatch.setattr(judging, "_details_of", lambda _, result, __: seen.append(result))
    monkeypatch.setattr(judging, "joined", list)
    monkeypatch.setattr(judging, "compared", lambda _: (gain, None))
    targets = [learned_registrar()] * 3
    assert best_of_meshes(results, targets).mesh_index == 0
    assert seen == []
    assert best_of_meshes(results, targets, Mock()).mesh_index == 1
    assert seen == results[:2]


def test_meshes_with_equal_scores_share_the_probability():
    found = best(result_of(0.8, 0.96), result_of(0.8, 0.9), result_of(0.1, 0.2))
    assert found.mesh_probabilities == pytest.approx((0.48, 0.48, 0.0), abs=0.01)
    assert found.mesh_index == 0
    assert found.confidence == pytest.approx(0.48, abs=0.01)
    assert found.ambiguous == "mesh 0 or 1"


def test_meshes_that_fail_are_left_out():
    failed = FailedRegistration(LostObjectError("not found"))
    one = result_of(0.8, 0.9)
    assert best(failed, one).mesh_index == 1
    assert best(one, failed).confidence == 0.9
    assert best(failed, failed) is failed
    found = best(failed, one, result_of(0.8, 0.9))
    assert found.mesh_probabilities == pytest.approx((0.0, 0.45, 0.45))


def test_without_probabilities_the_higher_score_decides():
    one = replace(result_of(0.8, 0.9), probabilities=())
    better = tuple(replace(h, score=0.9) for h in one.hypotheses)
    assert best(one, replace(one, hypotheses=better)).mesh_index == 1
    assert best(one, one).mesh_index == 0


def test_details_of_meshes_with_fewer_points_are_filled_with_invalid_ones():
    def details(count):
        ones = torch.ones(1, count)
        return ContourDetails(torch.ones(1, count, 2), ones, ones.bool(), ones.bool())

    both = joined([details(3), details(5)])
    assert both.uv.shape == (2, 5, 2)
    assert both.valid.sum(dim=1).tolist() == [3, 5]


@pytest.mark.parametrize("best", [0, 1])
def test_boxes_are_corrected_for_the_best_mesh_alone(monkeypatch, best):
    registrar = Registrar([truck_bank()] * 2)
    image, box, _ = scene(0)
    rough = box - torch.tensor([0.1, 0.0, 0.0, 0.0]) * (box[2] - box[0])
    one = truck_answer()
    first = one.hypotheses[0]
    asked = []

    def register_boxes(target, items):
        is_best = (target is registrar) == (best == 0)
        asked.extend(is_best for _ in items)
        evidence = first.evidence | {"similarity": 0.9 if is_best else 0.1}
        hypotheses = (replace(first, evidence=evidence),)
        return [replace(one, hypotheses=hypotheses, probabilities=(0.4,)) for _ in items]

    monkeypatch.setattr(stages, "register_boxes", register_boxes)
    assert answer_of(registrar, image, rough).mesh_index == best
    assert asked == [best == 0, best == 1, True]
