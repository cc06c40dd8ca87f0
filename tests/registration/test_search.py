"""The preset "paper": its stages, and its search between coherent views."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
import trimesh
from torch.testing import assert_close

from curvireg_torch import Registrar, ViewBank
from curvireg_torch.fitting.keypoints import KeypointMatches
from curvireg_torch.geometry import (
    PosePrior,
    paper_views,
    rotation_error,
    rotation_from_viewpoint,
    sample_views,
    viewpoint_from_rotation,
)
from curvireg_torch.matching import search
from curvireg_torch.mesh.mesh import principal_rotation
from curvireg_torch.pipeline import PRESETS, BankSettings, Pipeline, ViewPolicy
from curvireg_torch.registration import block, hypotheses, stages
from curvireg_torch.terms import Appearance
from tests._support import answer_of, answer_to, bank_of, double, eye, refused, scene, truck_bank


def test_coherent_views_are_connected_with_the_best_by_neighbours():
    angles = torch.tensor([[10.0, 20, 0], [30, 20, 0], [50, 60, 0], [90, 20, 0], [10, 20, 90]])
    assert search.coherent_views(angles).tolist() == [True, True, True, False, False]
    assert search.coherent_views(angles[[0, 2, 3]]).tolist() == [True, False, False]
    assert search.coherent_views(angles, (5.0, 5.0, 5.0)).tolist() == [True] + [False] * 4


def test_angles_near_run_on_past_the_pole():
    one = paper_views()[::6]
    angles = torch.stack([one.azimuth, one.elevation, one.theta], dim=1).double()
    same = search.angles_near(angles, angles[20])
    before, after = (rotation_from_viewpoint(*x.unbind(1)) for x in (angles, same))
    assert_close(before, after, rtol=0, atol=1e-6)
    assert same[20].tolist() == angles[20].tolist()
    past = 2 * 18 + 2  # elevation 100 degrees, above elevation 50 with the same azimuth
    assert torch.allclose(same[past] - same[20], double([0.0, 50.0, 0.0]), atol=1e-4)


def test_divided_contains_both_ends():
    for end, angles in ((30.0, [10, 15, 20, 25, 30]), (12.0, [10, 12]), (10.0, [10])):
        assert search.divided(10.0, end, 5.0).tolist() == angles


def test_motion_is_the_frobenius_norm_of_the_relative_transform_in_radii():
    R, S = rotation_from_viewpoint(double([20.0, 50.0]), 10.0, double([0.0, 4.0]))
    first = eye(4)
    second = eye(4)
    first[:3, :3], second[:3, :3] = R, S
    first[2, 3], second[2, 3] = 5.0, 5.4
    E = torch.linalg.matrix_norm(torch.linalg.inv(first) @ second - eye(4))
    assert search.motion((R, first[2, 3]), (S, second[2, 3])) == pytest.approx(float(E), rel=1e-9)


class Peak:
    """A matcher that knows the best view: the nearer a view is to it, in angle and distance, the
    better."""

    def __init__(self, bank, truth, distance):
        self.bank = bank
        self.compared = []
        self.truth = truth
        self.distance = distance

    def scores_near(self, truth, views):
        angle = rotation_error(views.rotations, truth.float())
        return -(angle.square()) / 100.0 - (views.distance - self.distance).square()

    def scores(self, views):
        return self.scores_near(self.truth, views)

    def compare_views(self, _, views):
        self.compared.append(views)
        return self.scores(views)


class TwoPeaks(Peak):
    """A second view, 10 degrees of azimuth farther, is nearly as good as the best."""

    def scores(self, views):
        farther = rotation_from_viewpoint(10.0, 0.0) @ rotation_from_viewpoint(0.0, 0.0).T
        second = self.scores_near(farther.double() @ self.truth, views) - 0.01
        return torch.maximum(super().scores(views), second)


class Scattered(Peak):
    """The best view has no neighbour among the best three: azimuths of 100 and 180 follow it."""

    def scores(self, views):
        far = ((views.azimuth - 140.0).abs().round() == 40.0) & (views.elevation.abs() < 1.0)
        return torch.where(far, -0.6, super().scores(views))


@cache
def neighbours(camera, frame):
    """A grid of views, the rotation of its frame, and the bank of these views of a box."""
    mesh = trimesh.creation.box((1, 2, 3))
    pipeline = Pipeline(
        views=ViewPolicy(frame=frame), bank=BankSettings(image_size=32, camera=camera)
    )
    turn = principal_rotation(mesh) if frame == "principal" else eye(3)
    grid = sample_views(azimuth_step=20, elevations=[0, 50], distances=[3.0, 4.5])
    return grid, turn, bank_of(mesh, grid.in_frame(turn), pipeline=pipeline)


def searched(*truth, camera="perspective", frame="own", allowed=0.0, kind=Peak, least_coherent=1):
    """Error of the rotation in degrees and distance in radii that the search finds on a bank of
    neighbours, and the matcher; azimuths from ``allowed`` on are allowed."""
    grid, turn, bank = neighbours(camera, frame)
    azimuth, elevation, distance = truth
    R = rotation_from_viewpoint(azimuth, elevation).double() @ turn
    matcher = kind(bank, R, distance)
    matcher.turn = turn
    order = matcher.scores(bank.views).argsort(descending=True, stable=True)[None]
    matcher.ranking = SimpleNamespace(order=order, allowed=grid.azimuth[None] >= allowed)
    rotation, found = search.search(matcher, None, matcher.ranking, least_coherent=least_coherent)
    return float(rotation_error(rotation, R)), float(found) / (0.5 * 14**0.5), matcher


def azimuths(views):
    return sorted(set(views.azimuth.round().tolist()))


def test_search_looks_between_the_least_and_greatest_angles_and_distances():
    error, distance, matcher = searched(207.0, 0.0, 3.7)
    first = matcher.compared[0]
    assert azimuths(first) == [200, 205, 210, 215, 220]
    assert sorted(set(first.distance.tolist())) == [3.0, 3.25, 3.5, 3.75, 4.0, 4.25, 4.5]
    assert error < 2.0
    assert distance == pytest.approx(3.7, abs=0.1)


def test_further_rounds_are_between_views_that_are_neighbours_on_the_finer_grid():
    """Of the three best views of the first round one is two of its steps away."""
    _, _, matcher = searched(205.0, 0.0, 3.75, kind=TwoPeaks)
    first, second = matcher.compared[:2]
    assert azimuths(first) == [200, 205, 210, 215, 220]
    best = matcher.scores(first).argsort(descending=True)[:3]
    assert sorted(first.azimuth[best].round().tolist()) == [205, 205, 215]
    assert azimuths(second) == [205]


def test_views_down_the_ranking_give_the_search_something_to_search():
    options = {"camera": "orthographic", "kind": Scattered}
    error, _, matcher = searched(7.0, 0.0, 3.0, **options)
    assert error == pytest.approx(7.0, abs=1e-3)
    assert len(search.coherent_of(matcher.bank, matcher.ranking)) == 1
    assert [len(views) for views in matcher.compared] == [1]
    error, _, matcher = searched(7.0, 0.0, 3.0, **options, least_coherent=2)
    assert azimuths(matcher.compared[0]) == [0, 5, 10, 15, 20]
    assert error < 2.5


def test_a_view_is_refined_among_its_neighbours():
    _, _, matcher = searched(24.0, 46.0, 3.0)
    wanted = rotation_from_viewpoint(25.0, 45.0)
    view = int(rotation_error(matcher.bank.rotations, wanted).argmin())
    refined = search.refine(matcher, None, view)
    assert rotation_error(refined, wanted.double()) < 1e-3
    assert len(matcher.compared[-1]) == 9


def test_different_views_differ_in_rotation_however_little():
    azimuths = torch.tensor([10.0, 10.0, 11.0, 190.0, 11.0, 300.0])
    rotations = rotation_from_viewpoint(azimuths.double(), 20.0)
    order = torch.tensor([2, 4, 1, 0, 3, 5])
    assert search.different_views(rotations, order, 3).tolist() == [2, 1, 3]
    assert search.different_views(rotations, order, 9).tolist() == [2, 1, 3, 5]


def test_search_is_between_allowed_views():
    _, _, matcher = searched(207.0, 0.0, 3.7, allowed=240.0)
    assert matcher.compared[0].azimuth.min() >= 240.0 - 1e-3


def test_search_is_in_the_frame_of_the_views():
    error, _, matcher = searched(207.0, 0.0, 3.7, frame="principal")
    assert error < 2.1
    in_frame = matcher.compared[0].rotations.double() @ matcher.turn.T
    azimuth, elevation, _ = viewpoint_from_rotation(in_frame)
    assert azimuth.round().unique().tolist() == [200, 205, 210, 215, 220]
    assert not elevation.round().any()


def test_search_stops_by_the_motion(monkeypatch):
    for stop, rounds, expected in (
        (1e9, 1, (2.0, 0.05)),
        (0.2, 2, (0.5, 0.05)),
        (search.STOP_MOTION, 4, (0.125, 0.0125)),
    ):
        monkeypatch.setattr(search, "STOP_MOTION", stop)
        error, distance, matcher = searched(207.0, 0.0, 3.7)
        assert len(matcher.compared) == rounds
        assert (error, abs(distance - 3.7)) == pytest.approx(expected, abs=1e-4)


def test_an_orthographic_search_keeps_the_distance_that_it_cannot_see():
    _, distance, matcher = searched(207.0, 20.0, 3.0, camera="orthographic")
    assert set(matcher.compared[0].distance.tolist()) == {3.0}
    # three directions
    assert sorted(set(matcher.compared[0].elevation.round().tolist()))[:3] == [0, 5, 10]
    assert distance == pytest.approx(3.0)


def test_preset_paper_runs_the_stages_of_the_paper_and_no_other(monkeypatch):
    for owner, name in (
        (block, "fit_poses"),
        (stages, "with_short_fit"),
        (stages, "with_edge_support"),
        (stages, "fit_texture_of"),
        (stages, "EdgeCrops"),
        (hypotheses, "fit_to_edges"),
        (KeypointMatches, "agreeing"),
        (Appearance, "build"),
        (Registrar, "object_mask"),
    ):
        monkeypatch.setattr(owner, name, Mock(side_effect=AssertionError("not of the paper")))
    paper = PRESETS["paper"]
    shown = {}
    progress = {"progress": lambda stage, *_: shown.setdefault(stage)}
    bank = ViewBank.build(truck_bank().mesh, pipeline=paper, **progress)
    result = answer_to(0, Registrar(bank, **progress))
    assert list(shown) == ["bank", "ranking", "search"]
    assert list(result.ranking.terms) == ["hog", "repeatability"]
    assert len(result.hypotheses) == 1
    assert result.confidence is None
    assert result.hypotheses[0].edge_support is None
    assert (paper.field, paper.box_jitter) == ("MFC", 0.0)
    assert (paper.search, paper.contours) == (True, False)
    assert len(bank) == 756
    assert (bank.settings.camera, bank.settings.formula) == ("orthographic", "paper")


def test_paper_views_are_those_of_the_principal_axes_and_poses_those_of_the_mesh():
    """A rotated copy of the mesh has the same views, and its pose in the same photograph is rotated
    alike."""
    turn = rotation_from_viewpoint(70.0, 25.0, 40.0).double()
    T = eye(4)
    T[:3, :3] = turn
    mesh = truck_bank().mesh
    copy = replace(mesh, surface=mesh.surface.copy().apply_transform(T.numpy()))
    paper = PRESETS["paper"]
    small = replace(paper, bank=replace(paper.bank, image_size=64))
    one, other = (bank_of(shape, pipeline=small) for shape in (mesh, copy))
    assert_close(other.rotations.double() @ turn, one.rotations.double(), rtol=0, atol=1e-5)
    in_frame = one.rotations.double() @ principal_rotation(mesh).T
    assert_close(in_frame, paper_views().rotations.double(), rtol=0, atol=1e-5)
    image, box, _ = scene(0)
    first, second = (answer_of(Registrar(bank), image, box, None) for bank in (one, other))
    # the allocentric one is what is searched for: the other follows from the centre of a box, which
    # does not turn with the mesh
    found = second.allocentric_rotation @ turn
    assert rotation_error(found, first.allocentric_rotation) < 0.1


def test_the_search_starts_from_allowed_views_and_ends_within_the_limits():
    image, box, T = scene(0)
    right = float(viewpoint_from_rotation(T[:3, :3])[0])
    prior = PosePrior(azimuth=((right + 90.0) % 360.0, (right + 180.0) % 360.0))
    pipeline = replace(PRESETS["paper"], views=ViewPolicy(pose="upright"))
    registrar = Registrar(truck_bank().mesh, pipeline=pipeline)
    result = answer_of(registrar, image, box, None, prior=prior)
    away = (result.viewpoint[0] - right) % 360.0
    assert 90.0 - 1e-3 <= away <= 180.0 + 1e-3


def test_search_and_contour_fit_exclude_each_other():
    with refused("contours=False"):
        Pipeline(search=True)
    assert Pipeline(search=True, contours=False).search
