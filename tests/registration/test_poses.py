"""Poses under work: views that start them, which of them are distinct, and those that are put back."""

from dataclasses import fields

import pytest
import torch

from curvireg_torch.geometry import rotation_error, rotation_from_axis_angle, symmetry_transforms
from curvireg_torch.matching import Ranking
from curvireg_torch.registration.poses import Poses, best_views, distinct_poses, lifted, placed
from tests._support.scenes import CAMERA, scene, truck_bank, truck_registrar

HALF_TURN = {"symmetries_discrete": [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}


def poses(image: list[int], degrees: list[float]) -> Poses:
    """Poses that differ by rotations about one axis."""
    axis_angle = torch.zeros(len(image), 3, dtype=torch.float64)
    axis_angle[:, 1] = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    empty = {f.name: torch.arange(len(image)) for f in fields(Poses)}
    rotation = rotation_from_axis_angle(axis_angle)
    return Poses(**{**empty, "image_index": torch.tensor(image), "rotation": rotation})


@pytest.mark.parametrize(
    ("image", "degrees", "score", "expected"),
    [
        ([0, 0, 0, 0], [0.0, 14.0, 16.0, 180.0], [0.9, 0.8, 0.7, 0.6], [True, False, True, True]),
        ([0, 1, 1, 1], [0.0, 1.0, 14.0, 180.0], [0.9, 0.8, 0.7, 0.6], [True, True, False, True]),
        ([0, 0], [0.0, 10.0], [0.1, 0.2], [False, True]),
    ],
    ids=["15 degrees", "per image", "best is kept"],
)
def test_distinct_poses(image, degrees, score, expected):
    assert distinct_poses(poses(image, degrees), torch.tensor(score)).tolist() == expected


def test_symmetric_poses_are_not_distinct():
    turned = poses([0, 0], [0.0, 0.0])
    turned.rotation[1] = turned.rotation[1] @ torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    score = torch.tensor([2.0, 1.0])
    assert distinct_poses(turned, score).tolist() == [True, True]
    assert distinct_poses(turned, score, symmetry_transforms(HALF_TURN)).tolist() == [True, False]


def test_poses_are_joined_in_the_order_of_their_photographs():
    joined = Poses.cat([poses([0, 2], [1.0, 2.0]), poses([1, 2], [3.0, 4.0])])
    assert joined.image_index.tolist() == [0, 1, 2, 2]
    assert torch.equal(joined.rotation[1], poses([1], [3.0]).rotation[0])
    put = joined.replaced(torch.tensor([1]), poses([9], [50.0]))
    assert put.image_index.tolist() == [0, 9, 2, 2]


def ranking(scores: torch.Tensor, allowed: torch.Tensor | None = None) -> Ranking:
    return Ranking(scores, scores.argsort(dim=1, descending=True, stable=True), {}, allowed)


def test_best_views_are_distinct_and_ranked_relative_to_the_best():
    scores = torch.full((2, len(truck_bank())), 0.01)
    scores[0, [4, 5, 60]] = torch.tensor([0.8, 0.7, 0.2])  # 4 and 5 are neighbours
    scores[1, 7] = 0.04
    image_index, view, rank = best_views(ranking(scores), truck_bank(), count=2)
    assert image_index.tolist() == [0, 0, 1, 1]
    assert view[:3].tolist() == [4, 60, 7]
    assert rank[:3].tolist() == pytest.approx([0.0, float(torch.tensor(0.25).log()), 0.0], abs=1e-6)
    assert float(rank[3]) == pytest.approx(float(torch.tensor(0.25).log()))


def test_best_views_are_allowed_ones():
    allowed = torch.arange(len(truck_bank()))[None] < 1
    scores = torch.linspace(0.1, 0.9, len(truck_bank()))[None]
    assert best_views(ranking(scores, allowed), truck_bank(), count=5)[1].tolist() == [0]


def test_lifted_poses_fill_their_boxes_and_placed_ones_agree():
    describer, (_, box, T) = truck_registrar().describer, scene(0)
    rotation = T[None, :3, :3]
    one = torch.ones(1, dtype=torch.float64)
    centre = T[:3, :3] @ describer.centre + T[:3, 3]
    index = torch.zeros(1, dtype=torch.long)
    start = lifted(describer, index, index, 0.0 * one, rotation, one, box[None].double(), CAMERA[None])
    exact = placed(start, T[None], describer.centre)
    torch.testing.assert_close(exact.distance, centre.norm()[None])
    again = lifted(describer, index, index, 0.0 * one, exact.rotation, one, box[None].double(), CAMERA[None])
    assert float(rotation_error(again.T[0, :3, :3], T[:3, :3])) < 2.0
    assert float((again.T[0, :3, 3] - T[:3, 3]).norm() / T[:3, 3].norm()) < 0.03
