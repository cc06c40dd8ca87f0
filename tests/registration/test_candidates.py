"""The poses that compete for one photograph."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from curvireg_torch.evidence import Evidence, EvidenceWeights
from curvireg_torch.registration.candidates import Candidates
from curvireg_torch.registration.poses import Poses

WEIGHTS = EvidenceWeights.only(similarity=10.0)


def candidates(*similarity: float) -> Candidates:
    count = len(similarity)
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, 2, 3] = 5.0
    views = torch.arange(count)
    cameras = torch.eye(3).double().expand(count, 3, 3)
    poses = Poses.at(T, cameras, torch.zeros(3).double(), views, -views.double())
    return Candidates.of(poses, of_similarity(*similarity))


def of_similarity(*similarity: float) -> Evidence:
    return replace(
        Evidence.zeros(len(similarity)), similarity=torch.tensor(similarity, dtype=torch.float64)
    )


def test_the_best_pose_is_neither_outside_the_limits_nor_merged_with_another():
    found = candidates(0.5, 0.7, 0.9, 0.6)
    assert found.best(WEIGHTS).tolist() == [2]
    found = replace(found, outside=torch.tensor([False, False, True, False]))
    assert found.best(WEIGHTS).tolist() == [1]
    found = replace(found, distinct=torch.tensor([True, False, True, True]))
    assert found.best(WEIGHTS).tolist() == [3]
    assert found.scores(WEIGHTS).tolist() == [5.0, -torch.inf, -torch.inf, 6.0]


@pytest.mark.parametrize("keeps", [None, True, False])
def test_fitted_poses_take_their_places_unless_they_exceed_the_limits(keeps):
    before = candidates(0.5, 0.7, 0.9)
    index = torch.tensor([1])
    moved = replace(before.poses[index], T=2.0 * before.poses.T[index])
    limits: Any = None
    if keeps is not None:
        limits = SimpleNamespace(keeps=lambda poses: torch.tensor([keeps] * len(poses)))
    after = before.with_fitted(index, moved, of_similarity(0.8), limits)
    if keeps is False:
        assert after is before
        return
    assert after.evidence.similarity.tolist() == [0.5, 0.8, 0.9]
    changed = (after.poses.T != before.poses.T).flatten(1).any(dim=1)
    assert changed.tolist() == [False, True, False]
    assert after.distinct is before.distinct
