"""Evidence: what its kinds are read from, and what they count for."""

from dataclasses import fields

import pytest
import torch

from curvireg_torch.evidence import RANK_ALONE, Evidence, EvidenceWeights
from tests._support import double, refused
from tests._support.hypotheses import evidence_of

NAMES = [field.name for field in fields(Evidence)]


def test_every_kind_has_a_weight_of_its_name():
    assert [field.name for field in fields(EvidenceWeights)] == NAMES
    with refused("details"):
        EvidenceWeights(details=float("nan"))


@pytest.mark.parametrize("name", NAMES)
def test_the_score_is_the_weighted_sum(name):
    weights = EvidenceWeights.only(**{name: 2.0})
    assert evidence_of(**{name: [0.5, -1.0, 3.0]}).scores(weights).tolist() == [1.0, -2.0, 6.0]


@pytest.mark.parametrize("name", ["rank", "edge_support"])
def test_how_near_a_view_was_and_support_alone_are_no_evidence_for_a_fitted_pose(name):
    """Else of two poses that fit equally well the one with the nearer view would win by chance."""
    tied = evidence_of(similarity=[0.7, 0.7], **{name: [0.0, -1.335]})
    first, second = tied.scores(EvidenceWeights()).tolist()
    assert first == second


def test_a_similar_mesh_keeps_the_order_of_the_ranking():
    seen = evidence_of(rank=[-1.0, -2.0, 0.0], **{name: [5.0, 4.0, 3.0] for name in NAMES[1:]})
    assert seen.scores(RANK_ALONE).tolist() == [-1.0, -2.0, 0.0]


def test_evidence_is_read_from_poses():
    seen = {
        "rank": double([0.0, -1.0]),
        "similarity": double([0.7, 0.6]),
        "edge_support": double([0.4, torch.nan]),
        "appearance": double([0.5, -0.5]),
        "keypoints": double([0.0, 20.0]),
        "contours": double([0.3, 0.0]),
    }
    read = Evidence.measured(**seen)
    assert read.edge_support.tolist() == pytest.approx([0.4, 0.0])
    assert read.keypoints.expm1().tolist() == pytest.approx([0.0, 20.0])
    assert read.details.tolist() == [0.0, 0.0]
    assert read.contours.tolist() == pytest.approx([0.3, 0.0])
    assert list(read.named(1)) == NAMES
    assert read.named(1)["appearance"] == -0.5
    again = Evidence.of_hypotheses([read.named(0), read.named(1)])
    assert torch.equal(again.table, read.table)


def test_photographs_are_averaged_by_weight():
    both = Evidence.stack([evidence_of(details=[1.0]), evidence_of(details=[4.0])])
    mean = both.mean(double([2.0, 1.0]))
    assert mean.details.tolist() == [2.0]
    assert mean.rank.tolist() == [0.0]


def test_many_keypoints_outweigh_what_an_occluder_takes_away_and_one_does_not():
    four = evidence_of(
        similarity=[0.4, 0.1, 0.8, 0.6],
        contours=[0.3, 0.1, 0.5, 0.3],
        appearance=[0.0, -4.0, 0.0, -0.5],
        keypoints=torch.tensor([0.0, 20.0, 0.0, 1.0]).log1p().tolist(),
    )
    order = four.scores(EvidenceWeights()).argsort(descending=True)
    assert order.tolist() == [2, 3, 1, 0]
