"""The table of poses that compete in photographs: which views start them, which are distinct, which
is the best."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.evidence import EvidenceWeights
from curvireg_torch.geometry.cameras import point_in_cameras
from curvireg_torch.matching import Ranking
from curvireg_torch.registration import block as block_module
from curvireg_torch.registration.hypotheses import (
    Hypotheses,
    best_views,
    distinct_poses,
    placed,
)
from tests._support import CAMERA, check_near, double, scene, truck_bank, truck_registrar, zeros
from tests._support.hypotheses import evidence_of, placed_at, poses_at, target_of

WEIGHTS = EvidenceWeights.only(similarity=10.0)


def hypotheses(*similarity):
    return replace(poses_at(*[0.0] * len(similarity)), evidence=evidence_of(*similarity))


def test_the_best_pose_is_neither_outside_the_limits_nor_merged_with_another():
    found = hypotheses(0.5, 0.7, 0.9, 0.6)
    assert found.best(WEIGHTS).tolist() == [2]
    found = replace(found, is_outside=torch.tensor([False, False, True, False]))
    assert found.best(WEIGHTS).tolist() == [1]
    found = replace(found, is_distinct=torch.tensor([True, False, True, True]))
    assert found.best(WEIGHTS).tolist() == [3]
    assert found.scores(WEIGHTS).tolist() == [5.0, -torch.inf, -torch.inf, 6.0]


def test_each_photograph_has_its_own_best_pose():
    found = hypotheses(0.5, 0.7, 0.9, 0.6)
    found = replace(found, photograph=torch.tensor([1, 0, 1, 0]))
    assert found.best(WEIGHTS).tolist() == [1, 2]
    assert found.of(1).tolist() == [0, 2]


def test_poses_take_their_places_with_their_evidence_and_what_is_known_of_the_places_stays():
    before = replace(hypotheses(0.5, 0.7, 0.9), is_outside=torch.tensor([False, True, False]))
    index = torch.tensor([1])
    moved = replace(before[index], T=2.0 * before.T[index], evidence=evidence_of(0.8))
    after = before.with_poses(index, replace(moved, is_outside=torch.tensor([False])))
    assert after.evidence.similarity.tolist() == [0.5, 0.8, 0.9]
    changed = (after.T != before.T).flatten(1).any(dim=1)
    assert changed.tolist() == [False, True, False]
    assert after.is_outside.tolist() == [False, True, False]


def test_edges_are_measured_once_at_a_pose(monkeypatch):
    measured = []

    def edges(_, __, ___, poses):
        measured.append(len(poses))
        return torch.zeros(len(poses)), torch.full((len(poses),), 0.7, dtype=torch.float64)

    monkeypatch.setattr(block_module, "by_contours", edges)
    crops = SimpleNamespace(crops=True)
    poses = replace(poses_at(0.0, 90.0), edge_excess=double([0.2, torch.nan]))
    target = target_of(describer=None)
    assert block_module._contours(target, crops, poses).tolist() == [0.2, 0.7]
    assert measured == [1]
    elsewhere = placed(poses, poses.T.flip(0), zeros(3))
    assert block_module._contours(target, crops, elsewhere).tolist() == [0.7, 0.7]
    known = replace(poses, edge_excess=double([0.2, 0.3]))
    assert block_module._contours(target, crops, known).tolist() == [0.2, 0.3]
    assert measured == [1, 2]


def test_distinct_poses():
    for degrees, score, expected in (
        ([0.0, 14.0, 16.0, 180.0], [0.9, 0.8, 0.7, 0.6], [True, False, True, True]),
        ([0.0, 10.0], [0.1, 0.2], [False, True]),
    ):
        are_distinct = distinct_poses(poses_at(*degrees).rotation, torch.tensor(score), angle=15.0)
        assert are_distinct.tolist() == expected


def test_best_views_are_distinct_and_ranked_relative_to_the_best():
    scores = torch.full((1, len(truck_bank())), 0.01)
    scores[0, [4, 5, 60]] = torch.tensor([0.8, 0.7, 0.2])  # 4 and 5 are neighbours
    ranking = Ranking(scores, scores.argsort(dim=1, descending=True, stable=True), {}, None)
    view, rank = best_views(ranking, truck_bank(), count=2)
    assert view.tolist() == [4, 60]
    assert rank.tolist() == pytest.approx([0.0, math.log(0.25)], abs=1e-6)


def test_poses_fill_their_box():
    describer, (_, box, T) = truck_registrar().describer, scene(0)
    exact = placed_at(T[None], describer.centre)
    again = Hypotheses.in_boxes(
        describer, box[None], CAMERA[None], exact.rotation, exact.distance, exact.view, exact.rank
    )
    check_near(again.T[0], T, degrees=2.0, share=0.03)
    for poses in (exact, again):
        assert_close(poses.distance, point_in_cameras(poses.T, describer.centre).norm(dim=1))
