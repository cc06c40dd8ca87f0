"""Second fits of the best pose and of its close rivals, in closed cases."""

from dataclasses import fields, replace
from types import SimpleNamespace

import pytest
import torch

from curvireg_torch.evidence import Evidence, EvidenceWeights
from curvireg_torch.geometry import rotation_from_viewpoint, transform
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.registration import stages
from curvireg_torch.registration.hypotheses import Hypotheses
from tests._support.scenes import CAMERA

MOVE = 1e-3


def poses_at(*degrees):
    """Of the views 0, 1, ..., turned about the vertical axis."""
    R = torch.stack([rotation_from_viewpoint(angle, 30.0, 0.0).double() for angle in degrees])
    H = len(R)
    T = transform(R, torch.tensor([0.0, 0.0, 5.0]).double().expand(H, 3))
    rank = torch.zeros(H, dtype=torch.float64)
    return Hypotheses.at(T, CAMERA.expand(H, 3, 3), torch.zeros(3).double(), torch.arange(H), rank)


def evidence_of(*similarity):
    nothing = torch.zeros(len(similarity), dtype=torch.float64)
    values = Evidence(*[nothing] * len(fields(Evidence)))
    return replace(values, similarity=torch.tensor(similarity, dtype=torch.float64))


class Refits:
    """Fits that move poses to the right by ``MOVE``, where they have a ``new`` similarity by their
    view; which were fitted, and which were compared in detail."""

    def __init__(self, monkeypatch, new):
        self.new = new
        self.fitted: list[list[int]] = []
        self.compared: list[tuple[int, list[int]]] = []
        monkeypatch.setattr(stages, "fitted_poses", self.fit)
        monkeypatch.setattr(stages, "with_evidence", self.measure)
        monkeypatch.setattr(stages, "with_details", self.compare)

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

    def run(
        self,
        poses,
        evidence,
        outside=None,
        symmetries=None,
    ):
        """Which poses moved, and the evidence."""
        target = SimpleNamespace(score_weights=lambda **_: EvidenceWeights(), pipeline=Pipeline())
        block = SimpleNamespace(
            symmetries=symmetries, keeps=lambda poses: torch.ones(len(poses), dtype=torch.bool)
        )
        crops = None
        excluded = torch.tensor(outside or [False] * len(poses))
        before = replace(poses, evidence=evidence, is_outside=excluded)
        after = stages.refitted(target, block, crops, before)
        return (after.T != poses.T).flatten(1).any(dim=1).tolist(), after.evidence


def test_the_best_pose_and_its_close_rivals_are_fitted_again(monkeypatch):
    """A score of 2.5 is 0.25 of similarity."""
    refit = Refits(monkeypatch, {})
    poses = poses_at(0.0, 90.0, 180.0, 270.0)
    moved, evidence = refit.run(poses, evidence_of(0.7, 0.9, 0.66, 0.64))
    assert refit.fitted == [[1], [0, 2]]
    assert refit.compared == [(1, [0, 2])]
    assert not any(moved)
    assert (evidence.details == 1.0).all(), "of the comparison"


def test_results_with_a_higher_score_are_kept_and_no_others(monkeypatch):
    refit = Refits(monkeypatch, {0: 0.89, 1: 0.79, 2: 0.85})
    moved, evidence = refit.run(poses_at(0.0, 90.0, 180.0), evidence_of(0.9, 0.8, 0.7))
    assert moved == [False, False, True]
    assert evidence.similarity.tolist() == pytest.approx([0.9, 0.8, 0.85])
    refit = Refits(monkeypatch, {0: 0.95, 1: 0.84})
    moved, evidence = refit.run(poses_at(0.0, 90.0, 180.0), evidence_of(0.9, 0.8, 0.7))
    assert moved == [True, True, False]
    assert evidence.similarity.tolist() == pytest.approx([0.95, 0.84, 0.7])


def test_a_pose_that_stays_keeps_its_evidence(monkeypatch):
    """It is described as 1.0, which would be better."""
    refit = Refits(monkeypatch, {1: 0.85})
    moved, evidence = refit.run(poses_at(0.0, 90.0, 180.0), evidence_of(0.9, 0.8, 0.7))
    assert moved == [False, True, False]
    assert evidence.similarity.tolist() == pytest.approx([0.9, 0.85, 0.7])


def test_two_different_rivals_are_fitted_and_all_are_compared(monkeypatch):
    """The second is nearly the first, the fifth too many."""
    refit = Refits(monkeypatch, {})
    poses = poses_at(0.0, 90.0, 95.0, 180.0, 270.0)
    refit.run(poses, evidence_of(0.9, 0.85, 0.84, 0.83, 0.82))
    assert refit.fitted == [[0], [1, 3]]
    assert refit.compared == [(0, [1, 2, 3, 4])]


def test_symmetric_poses_are_no_rivals(monkeypatch):
    refit = Refits(monkeypatch, {})
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    group = torch.stack([torch.eye(4), half_turn])
    refit.run(poses_at(0.0, 180.0), evidence_of(0.9, 0.85), symmetries=group)
    assert refit.fitted == [[0]]
    assert refit.compared == []
    refit.run(poses_at(0.0, 180.0), evidence_of(0.9, 0.85))
    assert refit.compared == [(0, [1])]


def test_poses_outside_the_limits_are_neither_the_best_nor_rivals(monkeypatch):
    refit = Refits(monkeypatch, {})
    poses = poses_at(0.0, 90.0, 180.0)
    refit.run(poses, evidence_of(0.95, 0.9, 0.85), outside=[True, False, False])
    assert refit.fitted == [[1], [2]]
    assert refit.compared == [(1, [2])]
