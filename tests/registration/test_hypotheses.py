"""The table of poses that compete in photographs."""

from dataclasses import replace

import torch

from curvireg_torch.evidence import Evidence, EvidenceWeights
from curvireg_torch.registration.hypotheses import Hypotheses
from tests._support import double, eye

WEIGHTS = EvidenceWeights.only(similarity=10.0)


def hypotheses(*similarity):
    count = len(similarity)
    T = eye(4).repeat(count, 1, 1)
    T[:, 2, 3] = 5.0
    views = torch.arange(count)
    cameras = eye(3).expand(count, 3, 3)
    poses = Hypotheses.at(T, cameras, torch.zeros(3).double(), views, -views.double())
    return replace(poses, evidence=of_similarity(*similarity))


def of_similarity(*similarity):
    return replace(Evidence.zeros(len(similarity)), similarity=double(similarity))


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
    moved = replace(before[index], T=2.0 * before.T[index], evidence=of_similarity(0.8))
    after = before.with_poses(index, replace(moved, is_outside=torch.tensor([False])))
    assert after.evidence.similarity.tolist() == [0.5, 0.8, 0.9]
    changed = (after.T != before.T).flatten(1).any(dim=1)
    assert changed.tolist() == [False, True, False]
    assert after.is_outside.tolist() == [False, True, False]
