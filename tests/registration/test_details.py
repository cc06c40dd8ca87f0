"""Poses of nearly the same look: what only one of them predicts, and siblings by symmetries."""

from dataclasses import replace
from functools import cache

import pytest
import torch
import trimesh
from torch import Tensor

from curvireg_torch.geometry import rotation_from_viewpoint, transform
from curvireg_torch.mesh import mesh_radius
from curvireg_torch.registration import details
from curvireg_torch.registration.edges import EdgeCrops, EdgeField
from curvireg_torch.registration.poses import POSE_FEATURES, Poses
from curvireg_torch.registration.siblings import Siblings
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
    monkeypatch.setattr(EdgeField, "counts", lambda self, uv, valid, index: valid)
    everything, _ = compared(shift=-1.9)
    assert float((scores - everything).abs().max()) > 0.05


def four(features: list[list[float]], compare: list[list[float]], angles: list[float]) -> Siblings:
    """Siblings turned about z by ``angles``, the first of which has the highest score; all look
    different from the others."""
    R = torch.stack([rotation_from_viewpoint(angle, 30.0, 0.0).double() for angle in angles])
    T = transform(R, torch.tensor([0.0, 0.0, 5.0]).double().expand(len(R), 3))
    index = torch.zeros(len(T), dtype=torch.long)
    rank = torch.zeros(len(T), dtype=torch.float64)
    poses = Poses.at(T, CAMERA.expand(len(T), 3, 3), torch.zeros(3).double(), index, rank)
    different = ~torch.eye(len(T), dtype=torch.bool)
    rows = torch.tensor(features, dtype=torch.float64)
    return Siblings(poses, rows, torch.tensor(compare, dtype=torch.float64), different)


def evidence(similarity: float) -> list[float]:
    values = dict.fromkeys(POSE_FEATURES, 0.0)
    values["similarity"] = similarity
    return list(values.values())


def test_a_sibling_is_better_by_its_score_and_by_details():
    rows = [evidence(s) for s in (0.80, 0.79, 0.70)]
    equal = [[0.0] * 3] * 3
    assert four(rows, equal, [0, 90, 180]).best() == 0
    assert four(rows, [[0, 0, 0], [0.15, 0, 0], [0, 0, 0]], [0, 90, 180]).best() == 0
    assert four(rows, [[0, 0, 0], [0.25, 0, 0], [0, 0, 0]], [0, 90, 180]).best() == 1
    assert four(rows, [[0, 0, 0], [0.25, 0, 0], [1.5, 0, 0]], [0, 90, 180]).best() == 2
    assert four(rows, [[0, -9, -9], [0, 0, 0], [0, 0, 0]], [0, 90, 180]).best() == 0


def test_the_rival_is_the_best_other_sibling_that_is_far_and_looks_different():
    rows = [evidence(s) for s in (0.80, 0.79, 0.70, 0.60)]
    equal = [[0.0] * 4] * 4
    family = four(rows, equal, [0, 20, 100, 200])
    fitted = torch.tensor([evidence(0.9)], dtype=torch.float64)
    column = POSE_FEATURES.index("similarity")
    poses, features = family.rival(0, fitted)
    assert torch.equal(poses.T[0], family.poses.T[2]), "the nearer one is no rival"
    assert float(features[0, column]) == pytest.approx(0.8)
    alike = family.look_different.clone()
    alike[0, 2] = False
    poses, features = replace(family, look_different=alike).rival(0, fitted)
    assert torch.equal(poses.T[0], family.poses.T[3])
    assert float(features[0, column]) == pytest.approx(0.7)
    assert replace(family, look_different=torch.zeros(4, 4) > 0).rival(0, fitted) is None
    told = [[0.0] * 4, [0.0] * 4, [-0.5, 0, 0, 0], [-2.0, 0, 0, 0]]
    _, features = four(rows, told, [0, 20, 100, 200]).rival(0, fitted)
    assert float(features[0, POSE_FEATURES.index("details")]) == -0.5
