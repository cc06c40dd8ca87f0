"""Measures of poses, the starts of the fits and the table of scripts/benchmark/preferences.py."""

import pytest
import torch
import torch.nn.functional as F

from curvireg_torch.features.learned_field import LearnedCurvilinearSaliency
from curvireg_torch.geometry import rotation_error, rotation_towards
from curvireg_torch.geometry.cameras import projected_boxes
from curvireg_torch.geometry.crops import crop_transforms, square_boxes
from curvireg_torch.mesh import mesh_centre, mesh_radius
from curvireg_torch.mesh.mesh import extreme_points
from curvireg_torch.registration.contours.descent import ContourProblem, apply_twist
from curvireg_torch.registration.contours.points import EdgeField
from curvireg_torch.rendering import make_renderer
from curvireg_torch.terms import crop_regions
from scripts.benchmark import preferences
from tests.registration.contours.common import BOX, CUBE_POSE, K, cube, silhouette


def test_starts_fill_the_box_at_rotations_of_4_to_20_degrees():
    R, t, hull = CUBE_POSE[:3, :3], CUBE_POSE[:3, 3], extreme_points(cube())
    starts = preferences.starts_around(R, t, mesh_centre(cube()), hull, BOX.double(), K, seed=1)
    views = rotation_towards(starts[:, :3, :3] @ mesh_centre(cube()) + starts[:, :3, 3]).mT @ starts[:, :3, :3]
    angles = rotation_error(views, rotation_towards(t).mT @ R)
    assert 4.0 <= float(angles.min()) < float(angles.max()) <= 20.0
    sides = projected_boxes(hull, starts, K.expand(4, 3, 3))
    assert float((0.5 * (sides[:, :2] + sides[:, 2:]) - 0.5 * (BOX[:2] + BOX[2:])).abs().max()) < 0.1


def test_measures_prefer_the_true_pose_of_a_silhouette():
    """A cube of one colour on black: every measure that looks at edges or colours of the outline."""
    image = 0.8 * silhouette(cube(), CUBE_POSE).expand(3, -1, -1)
    crop = crop_regions([image], BOX[None, None], size=preferences.SIZE, margin=preferences.MARGIN)[:, 0]
    camera = crop_transforms(square_boxes(BOX[None], preferences.MARGIN), preferences.SIZE).double() @ K
    size, centre = preferences.SIZE, mesh_centre(cube())
    problem = ContourProblem(
        make_renderer(cube()), EdgeField(crop), torch.tensor([0]), camera, size, centre, mesh_radius(cube())
    )
    measures = preferences.Measures(problem, crop, LearnedCurvilinearSaliency())
    off = torch.tensor([[0.0] * 6, [0.05, -0.1, 0.05, 0.04, 0.02, 0.3]], dtype=torch.float64)
    values = measures(apply_twist(CUBE_POSE.repeat(2, 1, 1), off, centre))
    for name in ("gradient edges of the outline", "local colours inside and outside, outline"):
        assert float(values[name][0]) > 1.5 * float(values[name][1]), name
    assert all(bool(value.isfinite().all()) for value in values.values())


def test_contrast_is_that_of_the_two_sides():
    """Colours 0 and 1 without variance: 3 / (3 + 1e-3); along the border: none."""
    x = torch.arange(preferences.SIZE)
    measures = object.__new__(preferences.Measures)
    measures.crop = (x > 127).float().expand(3, preferences.SIZE, preferences.SIZE)
    uv = torch.tensor([[[127.5, 90.0], [127.5, 90.0]]], dtype=torch.float64)
    normals = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]], dtype=torch.float64)
    assert measures._contrast(uv, normals)[0].tolist() == pytest.approx([3 / 3.001, 0.0], abs=1e-6)


def test_saliency_near_contours_is_explained():
    size = preferences.SIZE
    measures = object.__new__(preferences.Measures)
    measures.saliency, measures.level = F.pad(torch.ones(1, 1), (100, size - 101, 50, size - 51)), torch.tensor(1.0)
    points = [torch.tensor([[[x, 50.0]]], dtype=torch.float64) for x in (104.0, 105.0)]
    valid = type("Points", (), {"valid": torch.ones(1, 1, dtype=torch.bool)})
    found = [float(measures._unexplained(uv, valid, torch.ones(1, size, size))) for uv in points]
    assert found == [0.0, -0.5]


def test_table_has_a_line_for_each_measure():
    truth = {"edges": 0.75, "colours": 0.5}
    groups = {"all": {"n": 8, "truth": truth}, "few": {"n": 2, "truth": truth}}
    record = {"date": "2026-01-01", "commit": "abc", "photographs": 3, "poses": 12, "groups": groups}
    lines = preferences.page(record).splitlines()
    assert lines[0] == "| prefers the truth | all (8) | few (2) |"
    assert lines[2:4] == ["| edges | 0.75 | 0.75 |", "| colours | 0.50 | 0.50 |"]
