"""Siblings of a pose in closed cases: which is better, and which is a rival."""

import math
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.evidence import EvidenceWeights
from curvireg_torch.geometry import rotation_from_axis_angle, transform
from curvireg_torch.registration import doubts
from curvireg_torch.registration.doubts import Siblings
from curvireg_torch.registration.hypotheses import Hypotheses
from curvireg_torch.registration.target import TellingSymmetries
from tests._support import double, eye, zeros
from tests._support.hypotheses import competing, evidence_of, poses_at, target_of


def four(similarity, compare, angles):
    """Siblings turned about z by ``angles``, the first of which has the highest score; all look
    different from the others."""
    poses = replace(poses_at(*angles), evidence=evidence_of(*similarity))
    different = ~torch.eye(len(poses), dtype=torch.bool)
    return Siblings(poses, double(compare), different, EvidenceWeights())


def test_a_sibling_is_better_by_its_score_and_by_details():
    """By what it has before the first one, not by what that one has before it."""
    for second, third, best in ((0, 0, 0), (0.15, 0, 0), (0.25, 0, 1), (0.25, 1.5, 2)):
        details = [[0, -9, -9], [second, 0, 0], [third, 0, 0]]
        assert four([0.80, 0.79, 0.70], details, [0, 90, 180]).best() == best


def test_the_rival_is_the_best_other_sibling_that_is_far_and_looks_different():
    rows = [0.80, 0.79, 0.70, 0.60]
    equal = [[0.0] * 4] * 4
    family = four(rows, equal, [0, 20, 100, 200])
    fitted = evidence_of(0.9)
    rival, is_hidden = family.rival(0, fitted, notable=False)
    assert torch.equal(rival.T[0], family.poses.T[2]), "the nearer one is no rival"
    assert float(rival.evidence.similarity) == pytest.approx(0.8)
    assert not is_hidden
    alike = family.look_different.clone()
    alike[0, 2] = False
    rival, is_hidden = replace(family, look_different=alike).rival(0, fitted, notable=False)
    assert torch.equal(rival.T[0], family.poses.T[3])
    assert float(rival.evidence.similarity) == pytest.approx(0.7)
    assert is_hidden
    told = [[0.0] * 4, [0.0] * 4, [-0.5, 0, 0, 0], [-2.0, 0, 0, 0]]
    rival, _ = four(rows, told, [0, 20, 100, 200]).rival(0, fitted, notable=False)
    assert float(rival.evidence.details) == -0.5


def test_siblings_that_look_alike_are_rivals_if_the_hidden_feature_is_notable():
    family = four([0.80, 0.79, 0.70], [[0.0] * 3] * 3, [0, 20, 100])
    family = replace(family, look_different=torch.zeros(3, 3, dtype=torch.bool))
    small, is_hidden = family.rival(0, evidence_of(0.9), notable=False)
    assert len(small) == 0
    assert is_hidden
    notable, is_hidden = family.rival(0, evidence_of(0.9), notable=True)
    assert torch.equal(notable.T[0], family.poses.T[2])
    assert is_hidden


class Case:
    """A pose at 0 degrees that lies outside the limits, the best at 40, and another at 80; three
    siblings of the best have the similarities ``measured``, a sibling that is fitted 0.95."""

    def __init__(self, monkeypatch, measured):
        self.fitted: list[Hypotheses] = []
        angles = double([0.0, 1.0, 2.0])[:, None] * double([0.0, 0.0, 2.0 * math.pi / 3.0])
        self.symmetries = transform(rotation_from_axis_angle(angles), zeros(3, 3))
        self.poses = four([0.0] * 3, [[0.0] * 3] * 3, [0, 40, 80]).poses
        different = ~torch.eye(3, dtype=torch.bool)
        monkeypatch.setattr(doubts, "fitted_poses", self.fit)
        monkeypatch.setattr(doubts, "by_contours", lambda *_: torch.arange(3))
        monkeypatch.setattr(doubts, "compared", lambda _: (zeros(3, 3), different))
        evidence = {3: evidence_of(*measured), 1: evidence_of(0.95)}
        monkeypatch.setattr(
            doubts,
            "with_evidence",
            lambda _, __, poses: replace(poses, evidence=evidence[len(poses)]),
        )

    def fit(self, target, block, crops, starts, *, refit):
        assert refit
        self.fitted.append(starts)
        moved = starts.T.clone()
        moved[:, 0, 3] += 1e-3
        return replace(starts, T=moved)

    def run(self, keeps=None):
        """``keeps``: what the limits say, one call after the other."""
        target = target_of(
            telling_symmetries=TellingSymmetries(self.symmetries, self.symmetries[:1]),
            describer=SimpleNamespace(device_contours=None, centre=zeros(3)),
        )
        answers = iter(keeps or [])
        block = MagicMock()
        block.__len__.return_value = 1
        block.keeps = lambda poses: torch.tensor([next(answers, True)] * len(poses))
        crops = None
        before = competing(self.poses, evidence_of(0.99, 0.9, 0.5), [True, False, False])
        after, rival, _ = doubts.with_siblings(target, block, crops, before)
        assert not rival.is_outside.any()
        assert rival.is_sibling.all()
        return after, after.evidence, rival


def test_the_best_pose_stays_and_its_sibling_is_its_rival(monkeypatch):
    case = Case(monkeypatch, [0.80, 0.75, 0.70])
    poses, changed, rival = case.run()
    assert torch.equal(poses.T, case.poses.T)
    assert changed.similarity.tolist() == pytest.approx([0.99, 0.9, 0.5])
    # a symmetry turns the model, before it is posed
    assert_close(rival.T[0], case.poses.T[1] @ case.symmetries[1])
    assert float(rival.evidence.similarity) == pytest.approx(0.9 + 0.75 - 0.80)
    assert not case.fitted


def test_a_better_sibling_is_fitted_and_the_pose_before_is_its_rival(monkeypatch):
    case = Case(monkeypatch, [0.80, 0.70, 0.90])
    poses, changed, rival = case.run()
    (start,) = case.fitted
    assert_close(start.T[0], case.poses.T[1] @ case.symmetries[2])
    assert float(poses.T[1, 0, 3] - start.T[0, 0, 3]) == pytest.approx(1e-3)
    assert torch.equal(poses.T[[0, 2]], case.poses.T[[0, 2]])
    assert changed.similarity.tolist() == pytest.approx([0.99, 0.95, 0.5])
    assert_close(rival.T[0], case.poses.T[1])
    assert float(rival.evidence.similarity) == pytest.approx(0.95 + 0.80 - 0.90)


def test_siblings_outside_the_limits_count_as_neither(monkeypatch):
    case = Case(monkeypatch, [0.80, 0.70, 0.90])
    poses, changed, rival = case.run(keeps=[False, False])
    assert torch.equal(poses.T, case.poses.T)
    assert changed.similarity.tolist() == pytest.approx([0.99, 0.9, 0.5])
    assert len(rival) == 0


def test_meshes_without_a_telling_feature_have_no_siblings(monkeypatch):
    case = Case(monkeypatch, [0.80, 0.75, 0.70])
    case.symmetries = eye(4)[None]
    poses, _, rival = case.run()
    assert torch.equal(poses.T, case.poses.T)
    assert len(rival) == 0
