"""Poses under work: which views start them, and which are distinct or put back."""

import math
from dataclasses import fields

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.geometry import rotation_error, rotation_from_axis_angle
from curvireg_torch.matching import Ranking
from curvireg_torch.registration.hypotheses import Hypotheses, best_views, distinct_poses
from tests._support import CAMERA, scene, truck_bank, truck_registrar


def rotation(x, y, z):
    """(3, 3) of an axis-angle vector in degrees."""
    return rotation_from_axis_angle(torch.deg2rad(torch.tensor([x, y, z], dtype=torch.float64)))


def poses(degrees):
    """Poses that differ by rotations about one axis."""
    number = torch.arange(len(degrees))
    R = torch.stack([rotation(0.0, angle, 0.0) for angle in degrees])
    return Hypotheses(**{**{f.name: number for f in fields(Hypotheses)}, "rotation": R})


def test_distinct_poses():
    for degrees, score, expected in (
        ([0.0, 14.0, 16.0, 180.0], [0.9, 0.8, 0.7, 0.6], [True, False, True, True]),
        ([0.0, 10.0], [0.1, 0.2], [False, True]),
    ):
        assert distinct_poses(poses(degrees), torch.tensor(score), angle=15.0).tolist() == expected


def test_best_views_are_distinct_and_ranked_relative_to_the_best():
    scores = torch.full((1, len(truck_bank())), 0.01)
    scores[0, [4, 5, 60]] = torch.tensor([0.8, 0.7, 0.2])  # 4 and 5 are neighbours
    ranking = Ranking(scores, scores.argsort(dim=1, descending=True, stable=True), {}, None)
    view, rank = best_views(ranking, truck_bank(), count=2)
    assert (view.tolist(), rank.tolist()) == (
        [4, 60],
        pytest.approx([0.0, math.log(0.25)], abs=1e-6),
    )


def test_poses_fill_their_box():
    describer, (_, box, T) = truck_registrar().describer, scene(0)
    none = torch.zeros(1, dtype=torch.long)
    exact = Hypotheses.at(T[None], CAMERA[None], describer.centre, none, none)
    assert_close(exact.distance, (T[:3, :3] @ describer.centre + T[:3, 3]).norm()[None])
    again = Hypotheses.in_boxes(
        describer, box[None], CAMERA[None], exact.rotation, exact.distance, none, none
    )
    assert rotation_error(again.T[0, :3, :3], T[:3, :3]) < 2.0
    assert ((again.T[0, :3, 3] - T[:3, 3]).norm() / T[:3, 3].norm()) < 0.03
    assert_close(
        again.distance, (again.T[0, :3, :3] @ describer.centre + again.T[0, :3, 3]).norm()[None]
    )
