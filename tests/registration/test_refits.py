"""Second fits of the best pose and of its close rivals, in closed cases."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch.registration import block
from tests._support import eye
from tests._support.hypotheses import (
    HALF_TURN,
    all_kept,
    competing,
    evidence_of,
    poses_at,
    target_of,
)

MOVE = 1e-3


class Refits:
    """Fits that move poses to the right by ``MOVE``, where they have a ``new`` similarity by their
    view; which were fitted, and which were compared in detail."""

    def __init__(self, monkeypatch, new):
        self.new = new
        self.fitted: list[list[int]] = []
        self.compared: list[tuple[int, list[int]]] = []
        monkeypatch.setattr(block, "fitted_poses", self.fit)
        monkeypatch.setattr(block, "with_evidence", self.measure)
        monkeypatch.setattr(block, "with_details", self.compare)

    def fit(self, target, block, crops, starts, *, refit):
        assert refit
        self.fitted.append(starts.view.tolist())
        T = starts.T.clone()
        moves = torch.tensor([view in self.new for view in starts.view.tolist()])
        T[moves, 0, 3] += MOVE
        return replace(starts, T=T)

    def measure(self, target, block, poses):
        new = evidence_of(*[self.new.get(view, 1.0) for view in poses.view.tolist()])
        return replace(poses, evidence=new)

    def compare(self, target, crops, poses, best, rivals):
        self.compared.append((int(best), rivals.tolist()))
        evidence = poses.evidence
        details = torch.ones_like(evidence.details)
        return replace(poses, evidence=replace(evidence, details=details))

    def run(self, poses, evidence, outside=None, symmetries=None):
        """Which poses moved, and the evidence."""
        some = SimpleNamespace(symmetries=symmetries, keeps=all_kept)
        crops = None
        before = competing(poses, evidence, outside)
        after = block.refitted(target_of(), some, crops, before)
        return (after.T != poses.T).flatten(1).any(dim=1).tolist(), after.evidence


@pytest.mark.parametrize(
    ("degrees", "similarity", "outside", "fitted", "compared"),
    [
        # a score of 2.5 is 0.25 of similarity
        ((0, 90, 180, 270), (0.7, 0.9, 0.66, 0.64), None, [[1], [0, 2]], [0, 2]),
        # the second rival is nearly the first, the fifth too many
        ((0, 90, 95, 180, 270), (0.9, 0.85, 0.84, 0.83, 0.82), None, [[0], [1, 3]], [1, 2, 3, 4]),
        # one outside the limits is neither the best nor a rival
        ((0, 90, 180), (0.95, 0.9, 0.85), [True, False, False], [[1], [2]], [2]),
    ],
)
def test_the_best_pose_and_two_close_rivals_are_fitted_again(
    monkeypatch, degrees, similarity, outside, fitted, compared
):
    refit = Refits(monkeypatch, {})
    moved, evidence = refit.run(poses_at(*degrees), evidence_of(*similarity), outside)
    assert refit.fitted == fitted
    assert refit.compared == [(fitted[0][0], compared)]
    assert not any(moved)
    assert (evidence.details == 1.0).all(), "of the comparison"


@pytest.mark.parametrize(
    ("new", "is_moved", "similarity"),
    [
        ({0: 0.89, 1: 0.79, 2: 0.85}, [False, False, True], [0.9, 0.8, 0.85]),
        ({0: 0.95, 1: 0.84}, [True, True, False], [0.95, 0.84, 0.7]),
        ({1: 0.85}, [False, True, False], [0.9, 0.85, 0.7]),
    ],
)
def test_results_with_a_higher_score_are_kept_and_no_others(monkeypatch, new, is_moved, similarity):
    """A pose that stays keeps its evidence, though it is described as 1.0, which is better."""
    refit = Refits(monkeypatch, new)
    moved, evidence = refit.run(poses_at(0.0, 90.0, 180.0), evidence_of(0.9, 0.8, 0.7))
    assert moved == is_moved
    assert evidence.similarity.tolist() == pytest.approx(similarity)


def test_symmetric_poses_are_no_rivals(monkeypatch):
    refit = Refits(monkeypatch, {})
    group = torch.stack([eye(4), HALF_TURN])
    refit.run(poses_at(0.0, 180.0), evidence_of(0.9, 0.85), symmetries=group)
    assert refit.fitted == [[0]]
    assert refit.compared == []
    refit.run(poses_at(0.0, 180.0), evidence_of(0.9, 0.85))
    assert refit.compared == [(0, [1])]
