"""Poses of nearly the same look: what only one of them predicts."""

from functools import cache

import pytest
import torch
import trimesh
from torch import Tensor

from curvireg_torch.fitting import details
from curvireg_torch.fitting.edges import EdgeCrops, EdgeField
from curvireg_torch.geometry import rotation_from_viewpoint, transform
from curvireg_torch.mesh import mesh_radius
from curvireg_torch.rendering.contours import MeshContours
from curvireg_torch.synthetic import synthesize_photograph
from tests._support.scenes import CAMERA, SIZE

TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))


@cache
def marked_box(unit: float = 1.0) -> trimesh.Trimesh:
    box = trimesh.creation.box((200, 120, 80))
    cube = trimesh.creation.box((30, 30, 30))
    cube.apply_translation((80, 0, 55))
    mesh = trimesh.util.concatenate([box, cube])
    mesh.apply_scale(unit)
    return mesh


def compared(*, shift: float = 0.0, unit: float = 1.0, wrong: float = 0.0) -> tuple[Tensor, Tensor]:
    """Of the true pose, of its half turn, and of the true one again, whose place is ``wrong`` by a
    fraction of the radius."""
    mesh = marked_box(unit)
    radius = mesh_radius(mesh)
    R = rotation_from_viewpoint(35.0, 30.0, 0.0).double()
    T = transform(R, radius * torch.tensor([shift, 0.0, 5.0]).double())
    image, box = synthesize_photograph(mesh, T, CAMERA, SIZE, torch.Generator().manual_seed(1))
    crops = EdgeCrops.cut([image], box[None], 0.1)
    again = T.clone()
    again[0, 3] += wrong * radius
    poses = torch.stack([T, T @ TURN, again])
    index = torch.zeros(3, dtype=torch.long)
    K = CAMERA.expand(3, 3, 3)
    return details.compare_details(MeshContours(mesh), crops, K, poses, index)


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_contours_that_are_in_the_photograph_speak_for_their_pose(unit):
    scores, differ = compared(unit=unit)
    assert differ.tolist() == [[False, True, False], [True, False, True], [False, True, False]]
    assert float(scores[0, 1]) > 0.5
    torch.testing.assert_close(scores, -scores.T)
    assert float(scores[0, 2]) == 0.0


def test_few_points_of_difference_weigh_less(monkeypatch):
    scores, _ = compared()
    monkeypatch.setattr(details, "ENOUGH_POINTS", 10**6)
    fewer, _ = compared()
    assert 0.0 < float(fewer[0, 1]) < 1e-2 * float(scores[0, 1])
    monkeypatch.setattr(details, "MIN_POINTS", 10**6)
    scores, differ = compared()
    assert not bool(differ.any())
    assert not bool(scores.any())


def test_the_middle_between_a_contour_and_none_is_half_of_what_shared_contours_have():
    """A pose beside the true one has contours where the photograph has none: they count against
    it, though the background has some texture."""
    scores, differ = compared(wrong=0.25)
    assert bool(differ[0, 2])
    assert float(scores[2, 0]) < -1.0


def test_what_lies_outside_the_photograph_does_not_count(monkeypatch):
    """The mark of the pose that is turned lies outside."""
    scores, _ = compared(shift=-1.9)
    monkeypatch.setattr(EdgeField, "counts", lambda _, __, valid, ___: valid)
    everything, _ = compared(shift=-1.9)
    assert float((scores - everything).abs().max()) > 0.05
