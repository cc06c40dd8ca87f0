"""Judgement of fitted poses in closed cases: order, rivals, limits, doubts."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
import trimesh

from curvireg_torch.matching import Ranking
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.registration import stages
from curvireg_torch.registration.hypotheses import Hypotheses
from curvireg_torch.registration.judging import judged
from tests._support import CAMERA, SIZE, double, eye, zeros
from tests._support.hypotheses import (
    HALF_TURN,
    competing,
    evidence_of,
    poses_at,
    target_of,
    turned,
)

HULL = 0.6 * torch.from_numpy(trimesh.creation.box().vertices)
BOX = torch.tensor([90.0, 60.0, 150.0, 120.0])


class Limits:
    """Limits that remember what they are asked."""

    def __init__(self):
        self.asked: list[tuple[Hypotheses, bool]] = []

    def contradiction(self, best, filling, *, better_outside):
        self.asked.append((best, better_outside))
        return "better outside" if better_outside else None


def judgement(
    poses,
    evidence,
    *,
    distinct=None,
    outside=None,
    pipeline=None,
    limits=None,
    symmetries=None,
    printed=0.0,
    **changes,
):
    """Of poses in a photograph that ``changes``."""
    target = target_of(
        pipeline=pipeline or Pipeline(),
        bank=SimpleNamespace(views=SimpleNamespace(rotations=turned(0.0, 90.0, 180.0).float())),
        describer=SimpleNamespace(hull=HULL, centre=zeros(3)),
        round_axis=None,
        mesh_warnings=("of the mesh",),
        mesh_notes=("note",),
    )
    item = SimpleNamespace(
        box=BOX,
        size=SIZE,
        focal_deviation=0.0,
        prior=None,
        warnings=("of the photograph",),
        camera=CAMERA,
        pinhole=None,
    )
    vars(item).update(changes)
    ranking = Ranking(torch.tensor([[1.0, 0.5, 0.25]]), torch.arange(3)[None], {})
    block = SimpleNamespace(
        exact=True,
        photographs=[item],
        rankings=[ranking],
        printed=lambda _: printed,
        limits=[limits],
        symmetries=symmetries,
        boxes=item.box[None].double(),
        cameras=CAMERA[None],
    )
    are_distinct = torch.tensor(distinct or [True] * len(poses))
    poses = replace(competing(poses, evidence, outside), is_distinct=are_distinct)
    return judged(target, block, 0, poses)


def order_of(result):
    return [hypothesis.view for hypothesis in result.hypotheses]


def test_poses_that_merged_come_last_and_are_no_rivals():
    evidence = evidence_of(0.6, 0.8, 0.9, 0.85)
    poses = poses_at(0.0, 90.0, 180.0, 270.0)
    result = judgement(poses, evidence, distinct=[True, True, False, False])
    assert order_of(result) == [1, 0, 2, 3]
    assert result.confidence_features["margin"] == pytest.approx(2.0)
    assert result.confidence_features["similarity"] == 0.8
    assert result.probabilities[2:] == (0.0, 0.0)
    assert result.probabilities[0] > result.probabilities[1] > 0.0


def test_only_so_many_are_reported_and_the_others_keep_their_shares():
    given = poses_at(0.0, 90.0, 180.0), evidence_of(0.6, 0.6, 0.6)
    every = judgement(*given)
    one = judgement(*given, pipeline=replace(Pipeline(), hypotheses=1))
    assert len(one.probabilities) == len(one.hypotheses) == 1
    assert one.probabilities == every.probabilities[:1]
    assert one.confidence_features == every.confidence_features
    assert one.confidence <= 1.0 / 3.0 + 1e-9


def test_poses_outside_the_limits_are_not_reported_and_contradict_them_if_they_are_better():
    poses = poses_at(0.0, 90.0, 180.0)
    for better, expected in ((0.09, None), (0.11, "better outside"), (-0.2, None)):
        limits = Limits()
        evidence = evidence_of(similarity=[0.7, 0.6, 0.7 + better], rank=[0.0, 0.0, -3.0])
        result = judgement(poses, evidence, outside=[False, False, True], limits=limits)
        assert order_of(result) == [0, 1]
        assert result.prior_contradiction == expected
        ((best, _),) = limits.asked
        assert best.view.tolist() == [0]


@pytest.mark.parametrize(("outside", "margin"), [(0.9, 0.0), (0.5, 1.0)])
def test_without_a_rival_inside_the_one_outside_is_compared(outside, margin):
    evidence = evidence_of(0.6, outside)
    poses = poses_at(0.0, 90.0)
    result = judgement(poses, evidence, outside=[False, True], limits=Limits())
    assert result.confidence_features["margin"] == pytest.approx(margin)
    alone = judgement(poses[:1], evidence[:1])
    assert alone.confidence_features["margin"] is None
    assert alone.confidence <= 0.5


def test_views_up_to_symmetries_are_near():
    """Of views at 0, 90 and 180 degrees."""
    two = torch.stack([eye(4), HALF_TURN])
    for symmetries, near in ((None, 1.0), (two, 1.0 + 0.25**4)):
        result = judgement(poses_at(0.0, 90.0), evidence_of(0.6, 0.5), symmetries=symmetries)
        share = result.confidence_features["ranking_share"]
        assert share == pytest.approx(near / (1.0 + 0.5**4 + 0.25**4))


@pytest.mark.parametrize("siblings", [[False, True], [True, False]])
def test_siblings_are_rivals_though_the_shape_looks_the_same(siblings):
    """A small feature of the mesh tells them apart; without one, both are one answer."""
    evidence = evidence_of(0.6, 0.5)
    poses = poses_at(0.0, 180.0)
    two = torch.stack([eye(4), HALF_TURN])
    assert judgement(poses, evidence, symmetries=two).probabilities[1] == 0.0
    told = replace(poses, is_sibling=torch.tensor(siblings))
    assert judgement(told, evidence, symmetries=two).probabilities[1] > 0.0


def test_doubts_are_those_of_the_best_pose():
    poses = poses_at(0.0, 90.0)
    known = torch.diag(double([0.01, 0.04, 0.09, 1.0, 1.0, 1.0]))
    poses.covariance[1] = known
    evidence = evidence_of(0.5, 0.6)
    box = torch.tensor([-0.5, 60.0, 150.0, 120.0])
    features = judgement(
        poses, evidence, focal_deviation=0.25, box=box, printed=3.0
    ).confidence_features
    assert features["unmatched"] == 3.0
    assert features["undetermined"] == pytest.approx(0.6)
    assert features["focal"] == 0.25
    assert features["border"] == 1
    assert features["outside"] == 0.0


def test_a_cut_object_is_doubtful_and_warned_of():
    """Half of it lies left of the photograph, whose border is 120 px from the optical axis."""
    x = -5.0 * 120.0 / 260.0
    result = judgement(poses_at(0.0, 90.0, x=x), evidence_of(0.6, 0.5))
    assert result.confidence_features["outside"] == pytest.approx(0.5, abs=0.05)
    assert result.warnings[:2] == ("of the photograph", "of the mesh")
    assert "outside the photograph" in result.warnings[2]
    assert result.notes == ("note",)


def test_views_of_merged_poses_are_needed_where_one_pose_is_left():
    """Of photograph 0 two are, of 1 one and the one outside the limits, of 2 one that others
    repeat."""
    poses = poses_at(*[0.0] * 9)
    flags = {
        "photograph": torch.tensor([0, 0, 0, 1, 1, 1, 2, 2, 2]),
        "is_distinct": torch.tensor([1, 1, 0, 1, 0, 1, 1, 0, 0]).bool(),
        "is_outside": torch.tensor([0, 0, 0, 0, 0, 1, 0, 0, 0]).bool(),
    }
    starts = replace(poses, is_repeated=torch.arange(9) == 8)
    needed = stages._needed(range(3), replace(poses, **flags), starts)
    assert needed.nonzero()[:, 0].tolist() == [0, 1, 3, 4, 5, 6, 7]
