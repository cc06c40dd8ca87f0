"""Siblings of a pose in closed cases: which is better, and which is a rival."""

from dataclasses import replace

import pytest
import torch

from curvireg_torch.evidence import Evidence, EvidenceWeights
from curvireg_torch.geometry import rotation_from_viewpoint, transform
from curvireg_torch.registration.poses import Poses
from curvireg_torch.registration.siblings import Siblings
from tests._support.scenes import CAMERA


def four(similarity: list[float], compare: list[list[float]], angles: list[float]) -> Siblings:
    """Siblings turned about z by ``angles``, the first of which has the highest score; all look
    different from the others."""
    R = torch.stack([rotation_from_viewpoint(angle, 30.0, 0.0).double() for angle in angles])
    T = transform(R, torch.tensor([0.0, 0.0, 5.0]).double().expand(len(R), 3))
    index = torch.zeros(len(T), dtype=torch.long)
    rank = torch.zeros(len(T), dtype=torch.float64)
    poses = Poses.at(T, CAMERA.expand(len(T), 3, 3), torch.zeros(3).double(), index, rank)
    different = ~torch.eye(len(T), dtype=torch.bool)
    details = torch.tensor(compare, dtype=torch.float64)
    return Siblings(poses, evidence(*similarity), details, different, EvidenceWeights())


def evidence(*similarity: float) -> Evidence:
    nothing = Evidence.zeros(len(similarity))
    return replace(nothing, similarity=torch.tensor(similarity, dtype=torch.float64))


def test_a_sibling_is_better_by_its_score_and_by_details():
    rows = [0.80, 0.79, 0.70]
    equal = [[0.0] * 3] * 3
    assert four(rows, equal, [0, 90, 180]).best() == 0
    assert four(rows, [[0, 0, 0], [0.15, 0, 0], [0, 0, 0]], [0, 90, 180]).best() == 0
    assert four(rows, [[0, 0, 0], [0.25, 0, 0], [0, 0, 0]], [0, 90, 180]).best() == 1
    assert four(rows, [[0, 0, 0], [0.25, 0, 0], [1.5, 0, 0]], [0, 90, 180]).best() == 2
    assert four(rows, [[0, -9, -9], [0, 0, 0], [0, 0, 0]], [0, 90, 180]).best() == 0


def test_the_rival_is_the_best_other_sibling_that_is_far_and_looks_different():
    rows = [0.80, 0.79, 0.70, 0.60]
    equal = [[0.0] * 4] * 4
    family = four(rows, equal, [0, 20, 100, 200])
    fitted = evidence(0.9)
    rival = family.rival(0, fitted, notable=False)
    assert torch.equal(rival.poses.T[0], family.poses.T[2]), "the nearer one is no rival"
    assert float(rival.evidence.similarity) == pytest.approx(0.8)
    assert not rival.feature_is_hidden
    alike = family.look_different.clone()
    alike[0, 2] = False
    rival = replace(family, look_different=alike).rival(0, fitted, notable=False)
    assert torch.equal(rival.poses.T[0], family.poses.T[3])
    assert float(rival.evidence.similarity) == pytest.approx(0.7)
    assert rival.feature_is_hidden
    told = [[0.0] * 4, [0.0] * 4, [-0.5, 0, 0, 0], [-2.0, 0, 0, 0]]
    rival = four(rows, told, [0, 20, 100, 200]).rival(0, fitted, notable=False)
    assert float(rival.evidence.details) == -0.5


def test_siblings_that_look_alike_are_rivals_if_the_hidden_feature_is_notable():
    family = four([0.80, 0.79, 0.70], [[0.0] * 3] * 3, [0, 20, 100])
    family = replace(family, look_different=torch.zeros(3, 3, dtype=torch.bool))
    small = family.rival(0, evidence(0.9), notable=False)
    assert len(small.poses) == len(small.evidence) == 0
    assert small.feature_is_hidden
    notable = family.rival(0, evidence(0.9), notable=True)
    assert torch.equal(notable.poses.T[0], family.poses.T[2])
    assert notable.feature_is_hidden
