"""The search on similarities that are known in closed form."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from curvireg_torch import camera_matrix, project_points, rotation_error
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.geometry.translation import pose_from_box
from curvireg_torch.registration import coherent_views
from curvireg_torch.registration import estimator as estimator_module
from curvireg_torch.registration.hypotheses import Hypotheses
from curvireg_torch.registration.search import REACH, _peak, search
from tests._support.scenes import CAMERA, scene, truck_bank, truck_registrar

CORNERS = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3) * torch.tensor([1.0, 1.4, 0.8])
K = camera_matrix(500.0, 500.0, 320.0, 240.0, dtype=torch.float64)


def rotation(x: float, y: float, z: float) -> Tensor:
    """(3, 3) of an axis-angle vector in degrees."""
    return rotation_from_axis_angle(torch.deg2rad(torch.tensor([x, y, z], dtype=torch.float64)))


IDENTITY = rotation(0, 0, 0)


class RotationDescriber:
    """Describes a view by its rotation: the similarity of two is (1 + 2 cos of the angle between them) / 3."""

    hull, centre, radius = CORNERS, torch.zeros(3, dtype=torch.float64), 1.0

    def __init__(self) -> None:
        self.calls: list[int] = []

    def descriptors(self, rotations: Tensor, _: Tensor) -> Tensor:
        self.calls.append(len(rotations))
        return rotations.flatten(1)


def hypothesis(R: Tensor, similarity: Tensor, distance: float = 9.0) -> Hypotheses:
    zero, one = torch.zeros(1, dtype=torch.long), torch.ones(1, dtype=torch.float64)
    return Hypotheses(zero, zero, zero, R[None], distance * one, one, similarity)


def searched(truth: Tensor, *views: Tensor, describer: RotationDescriber | None = None, **options: Any) -> Hypotheses:
    """The result of searching for ``truth`` from the first view of a bank."""
    rotations = torch.stack(views)
    bank = SimpleNamespace(rotations=rotations, model=torch.zeros(len(views), dtype=torch.long))
    ranking = SimpleNamespace(order=torch.arange(len(views))[None])
    start = hypothesis(views[0], torch.full((1,), torch.nan, dtype=torch.float64))
    describers = [describer or RotationDescriber()]
    return search(describers, truth.flatten()[None], start, bank=bank, ranking=ranking, **options)


def test_search_converges_to_the_truth():
    truth = rotation(3.0, -6.0, 4.0)
    result = searched(truth, IDENTITY)
    assert float(rotation_error(result.rotation[0], truth)) < 0.1
    assert float(result.similarity) == pytest.approx(1.0, abs=1e-5)
    assert float(result.ranking_score) == 1.0
    assert float(result.distance) == 9.0, "without a camera it stays"


@pytest.mark.parametrize("away", [16.0, 40.0, 170.0])
def test_search_stays_within_reach(away):
    result = searched(rotation(0.0, away, 0.0), IDENTITY)
    assert 10.0 < float(rotation_error(result.rotation[0], IDENTITY)) <= REACH == 15.0


def test_search_compares_coherent_views_first():
    angles = ((0, 0, 0), (0, 14.9, 0), (0, 15.1, 0), (9, 0, 0), (0, 0, 3), (1, 0, 0))
    views = torch.stack([rotation(*each) for each in angles])
    assert coherent_views(views, torch.tensor([0, 1, 2, 3, 4, 5])).tolist() == [0, 1, 3, 4]
    truth = rotation(0.0, 12.0, 5.0)  # steps alone would end near this view, not in it
    assert float(rotation_error(searched(truth, IDENTITY, truth).rotation[0], truth)) < 1e-4


def test_brief_search_takes_four_rounds_from_the_start_alone():
    truth, whole, brief = rotation(0.0, 12.0, 5.0), RotationDescriber(), RotationDescriber()
    searched(truth, IDENTITY, rotation(0, 1, 0), describer=whole)
    result = searched(truth, IDENTITY, rotation(0, 1, 0), describer=brief, brief=True)
    assert brief.calls == [1] + [6, 1] * 4
    assert whole.calls[0] == 2
    assert len(whole.calls) > len(brief.calls)
    assert float(rotation_error(result.rotation[0], truth)) < 0.1


def test_search_that_is_not_brief_needs_a_ranking():
    start = searched(IDENTITY, rotation(1, 0, 0))
    with pytest.raises(InvalidInputError, match="needs bank and ranking"):
        search([RotationDescriber()], torch.eye(3, dtype=torch.float64).view(1, 9), start, bank=truck_bank())


def test_peak_of_parabolas():
    """Scores 1 - sum (a_i - p_i)^2 / 100 of rotations by a about the axes, in degrees."""
    p = torch.tensor([1.5, -2.0, 0.5], dtype=torch.float64)
    steps = torch.cat([5.0 * torch.eye(3), -5.0 * torch.eye(3)]).double()
    scores = (1.0 - (steps - p).square().sum(dim=1) / 100.0)[None]
    state, step = hypothesis(IDENTITY, 1.0 - p.square().sum()[None] / 100.0), torch.tensor([5.0]).double()
    torch.testing.assert_close(_peak(state, scores, step)[0], rotation(*p.tolist()))
    scores[0, 1] = -1.0  # +y is out of reach: y stays
    torch.testing.assert_close(_peak(state, scores, step)[0], rotation(float(p[0]), 0.0, float(p[2])))


def test_search_places_the_object_so_that_it_fills_its_box():
    truth, t = rotation(20.0, 30.0, -10.0), torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    uv = project_points(CORNERS @ truth.T + t, torch.eye(4, dtype=torch.float64), K)
    box = torch.cat([uv.amin(dim=0), uv.amax(dim=0)])[None]
    result = searched(truth, truth @ rotation(4.0, -3.0, 2.0), boxes=box, camera_matrices=K[None])
    assert float(result.distance) == pytest.approx(4.0, rel=0.02)


def test_search_keeps_the_distance_that_belongs_to_its_rotation():
    """The distance is computed after the first of the two steps of 5 degrees that lead to the truth."""
    start = rotation(0.0, 40.0, 0.0)
    halfway, truth = rotation(5.0, 0.0, 0.0) @ start, rotation(10.0, 0.0, 0.0) @ start
    box = torch.tensor([[260.0, 150.0, 380.0, 330.0]], dtype=torch.float64)
    at_half, at_truth = (float(pose_from_box(CORNERS, R, box[0], K)[1].norm()) for R in (halfway, truth))
    assert abs(at_half / at_truth - 1.0) > 0.001
    result = searched(truth, start, boxes=box, camera_matrices=K[None])
    torch.testing.assert_close(result.rotation[0], truth)
    assert float(result.distance) == pytest.approx(at_half, rel=1e-9)


def test_registrar_searches_with_box_and_camera(monkeypatch):
    image, box, T = scene(0)
    registrar, brief_calls = truck_registrar(contours=False), []
    monkeypatch.setattr(estimator_module, "search", lambda *a, brief, **k: brief_calls.append(brief) or search(*a, **k))
    result = registrar([image], box[None], CAMERA)[0]
    truck_registrar()([image], box[None], CAMERA)
    assert brief_calls == [False, True]
    distance = float((T[:3, :3] @ registrar.describers[0].centre + T[:3, 3]).norm())
    assert result.distance == pytest.approx(distance, rel=0.05)
    assert registrar([image], box[None])[0].distance != pytest.approx(distance, rel=0.1), "without a camera"
