"""Poses of nearly the same look: what only one of them predicts."""

from functools import cache
from types import SimpleNamespace

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.fitting import details
from curvireg_torch.geometry import rotation_from_viewpoint, transform
from curvireg_torch.mesh import mesh_radius
from curvireg_torch.rendering.contours import MeshContours
from curvireg_torch.synthetic import synthesize_photograph
from tests._support import CAMERA, SIZE, double, eye, seeded
from tests._support.canisters import box_with_block
from tests._support.hypotheses import HALF_TURN
from tests.fitting.cube import crops_of


@cache
def marked_box(unit=1.0):
    return box_with_block((30, 30, 30), (80, 0, 55)).apply_scale(unit)


def compared(*, unit=1.0, wrong=0.0):
    """Of the true pose, of its half turn, and of the true one again, whose place is ``wrong`` by a
    fraction of the radius."""
    mesh = marked_box(unit)
    radius = mesh_radius(mesh)
    R = rotation_from_viewpoint(35.0, 30.0, 0.0).double()
    T = transform(R, radius * double([0.0, 0.0, 5.0]))
    image, box = synthesize_photograph(mesh, T, CAMERA, SIZE, seeded(1))
    again = T.clone()
    again[0, 3] += wrong * radius
    poses = torch.stack([T, T @ HALF_TURN, again])
    index = torch.zeros(3, dtype=torch.long)
    K = CAMERA.expand(3, 3, 3)
    return details.compare_details(MeshContours(mesh), crops_of(image, box), K, poses, index)


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_contours_that_are_in_the_photograph_speak_for_their_pose(unit):
    scores, differ = compared(unit=unit)
    assert differ.tolist() == [[False, True, False], [True, False, True], [False, True, False]]
    assert float(scores[0, 1]) > 0.5
    assert_close(scores, -scores.T)
    assert float(scores[0, 2]) == 0.0


def test_the_middle_between_a_contour_and_none_is_half_of_what_shared_contours_have():
    """A pose beside the true one has contours where the photograph has none: they count against
    it, though the background has some texture."""
    scores, differ = compared(wrong=0.25)
    assert differ[0, 2]
    assert float(scores[2, 0]) < -1.0


def closed_case(monkeypatch, places, *, padding=None, outside=-1.0):
    """Score of the first of two poses with contour points at ``places`` in px along a line, where
    all edges have a strength of 0.8; ``padding`` are places of points that are not valid, and at
    ``outside`` the photograph ends."""
    x = torch.full((2, 60), 900.0).double()
    valid = torch.zeros(2, 60, dtype=torch.bool)
    for row, (some, more) in enumerate(zip(places, padding or [[], []], strict=True)):
        x[row, : len(some) + len(more)] = double([*some, *more])
        valid[row, : len(some)] = True
    uv = torch.stack([x, torch.zeros_like(x)], dim=-1)
    points = SimpleNamespace(model=None, normals=None, valid=valid)
    problem = SimpleNamespace(
        state=lambda _: SimpleNamespace(points=points),
        strength_near=lambda uv, _: torch.full(uv.shape[:2], 0.8).double(),
        edges=SimpleNamespace(counts=lambda uv, valid, _: valid & (uv[..., 0] > outside)),
        K=None,
        centre=None,
    )
    monkeypatch.setattr(details.ContourProblem, "of", lambda *_: problem)
    monkeypatch.setattr(details, "pixels", lambda *_: uv)
    nothing = None
    T = eye(4).repeat(2, 1, 1)
    scores, differ = details.compare_details(nothing, nothing, nothing, T, nothing)
    assert_close(scores, -scores.T)
    assert torch.equal(differ, differ.T)
    return float(scores[0, 1]), bool(differ[0, 1])


def line(start, count):
    return [start + 10.0 * k for k in range(count)]


SHARED = line(0.0, 20)


@pytest.mark.parametrize(
    ("alone", "expected"),
    [
        (0, 0.0),
        (5, 0.0),  # too few to look different
        (6, 10.0 * 6 * 0.4 / 16),  # in proportion to their full weight
        (20, 10.0 * 0.4),
    ],
)
def test_points_of_one_pose_alone_count_by_their_strength_beyond_half_of_the_shared_ones(
    monkeypatch, alone, expected
):
    """Also where padding of the other pose happens to lie there."""
    own = line(400.0, alone)
    found = closed_case(monkeypatch, [SHARED + own, SHARED], padding=[[], own])
    assert found == (pytest.approx(expected), alone >= 6)
    found = closed_case(monkeypatch, [SHARED, SHARED + own], padding=[own, []])
    assert found == (pytest.approx(-expected), alone >= 6)


@pytest.mark.parametrize(("apart", "differs"), [(3.9, False), (4.1, True)])
def test_points_a_few_pixels_apart_are_the_same(monkeypatch, apart, differs):
    moved = [x + apart for x in SHARED]
    _, found = closed_case(monkeypatch, [SHARED, moved])
    assert found == differs


def test_a_pose_without_contours_shares_none(monkeypatch):
    """Then a contour counts against nothing."""
    found = closed_case(monkeypatch, [SHARED, []], padding=[[], SHARED])
    assert found == (pytest.approx(10.0 * 0.8), True)


def test_points_outside_the_photograph_are_no_details(monkeypatch):
    own = line(-200.0, 12)
    found = closed_case(monkeypatch, [SHARED + own, SHARED], outside=-95.0)
    assert found == (0.0, False), "one of twelve is inside"


def test_points_near_a_contour_outside_the_photograph_are_not_alone(monkeypatch):
    own = [-94.5] * 8
    beside = [-96.5] * 8
    assert closed_case(monkeypatch, [SHARED + own, SHARED + beside], outside=-95.0) == (0.0, False)
    alone = closed_case(monkeypatch, [SHARED + own, SHARED], outside=-95.0)
    assert alone == (pytest.approx(10.0 * 8 * 0.4 / 16), True)


def test_pairs_of_many_photographs_are_compared_as_each_alone():
    generator = seeded(0)
    uv = 60.0 * torch.rand(5, 40, 2, generator=generator).double()
    strength = torch.rand(5, 40, generator=generator).double()
    valid = torch.rand(5, 40, generator=generator) < 0.8
    counted = valid & (torch.rand(5, 40, generator=generator) < 0.8)
    table = details.ContourDetails(uv, strength, valid, counted)
    scores, differ = details.compared(table)
    first = torch.tensor([0, 3, 4])
    second = torch.tensor([2, 1, 0])
    found, looks_different = details.compare_pairs(table, first, second)
    assert differ[first, second].all()
    assert torch.equal(looks_different, differ[first, second])
    assert_close(found, scores[first, second])
    # by hand, of the first pair
    gains = []
    counts = []
    for a, b in ((0, 2), (2, 0)):
        far = torch.cdist(uv[a], uv[b][valid[b]]).amin(dim=1) > 4.0
        alone = strength[a][counted[a] & far]
        shared = strength[a][counted[a] & ~far]
        gains.append(float((alone - 0.5 * shared.mean()).sum()))
        counts.append(len(alone))
    expected = 10.0 * (gains[0] - gains[1]) / max(*counts, 16)
    assert float(found[0]) == pytest.approx(expected)
