"""The search in small steps, on similarities that are known in closed form."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from curvireg_torch import Registrar, camera_matrix, project_points, rotation_error
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_from_axis_angle
from curvireg_torch.geometry.translation import pose_from_box
from curvireg_torch.registration import coherent_views
from curvireg_torch.registration import registrar as registrar_module
from curvireg_torch.registration.hypotheses import Hypotheses
from curvireg_torch.registration.search import REACH, _peak, search
from tests._support.scenes import CAMERA, scene, truck_bank

CORNERS = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5], dtype=torch.float64)] * 3) * torch.tensor([1.0, 1.4, 0.8])


def turn(x: float, y: float, z: float) -> Tensor:
    """(3, 3) of a turn in degrees about x, y, z."""
    return rotation_from_axis_angle(torch.deg2rad(torch.tensor([x, y, z], dtype=torch.float64)))


class Turns:
    """Describes a view by its rotation: the similarity of two is (1 + 2 cos of the angle between them) / 3."""

    hull, centre, radius = CORNERS, torch.zeros(3, dtype=torch.float64), 1.0

    def __init__(self) -> None:
        self.asked: list[int] = []

    def descriptors(self, rotation: Tensor, _: Tensor) -> Tensor:
        self.asked.append(len(rotation))
        return rotation.flatten(1)


def around(truth: Tensor, start: Tensor, *others: Tensor, describe: Turns | None = None, **seen: Any) -> Hypotheses:
    """The search from ``start``, the first view of a bank, for ``truth``."""
    views = torch.stack([start, *others])
    one = torch.zeros(1, dtype=torch.long)
    begin = Hypotheses(one, one, one, start[None], torch.tensor([9.0], dtype=torch.float64), torch.ones(1).double())
    bank = SimpleNamespace(rotations=views, model=torch.zeros(len(views), dtype=torch.long))
    ranking = SimpleNamespace(order=torch.arange(len(views))[None])
    return search([describe or Turns()], truth.flatten()[None], begin, bank=bank, ranking=ranking, **seen)


def test_the_peak_between_the_views_is_found():
    truth = turn(3.0, -6.0, 4.0)
    found = around(truth, turn(0, 0, 0))
    assert float(rotation_error(found.rotation[0], truth)) < 0.1
    assert float(found.score) == pytest.approx(1.0, abs=1e-5)
    assert float(found.distance) == 9.0  # no camera says another


@pytest.mark.parametrize("away", [16.0, 40.0, 170.0])
def test_a_hypothesis_stays_within_its_reach(away):
    found = around(turn(0.0, away, 0.0), turn(0, 0, 0))
    assert 10.0 < float(rotation_error(found.rotation[0], turn(0, 0, 0))) <= REACH == 15.0


def test_coherent_views_of_the_bank_come_first():
    turns = ((0, 0, 0), (0, 14.9, 0), (0, 15.1, 0), (9, 0, 0), (0, 0, 3), (1, 0, 0))
    views = torch.stack([turn(*angles) for angles in turns])
    assert coherent_views(views, torch.tensor([0, 1, 2, 3, 4, 5])).tolist() == [0, 1, 3, 4]
    # Steps alone would end near the bank's view, not in it.
    truth = turn(0.0, 12.0, 5.0)
    assert float(rotation_error(around(truth, turn(0, 0, 0), truth).rotation[0], truth)) < 1e-4


def test_a_brief_search_takes_four_rounds_around_the_view_alone():
    truth, whole, brief = turn(0.0, 12.0, 5.0), Turns(), Turns()
    around(truth, turn(0, 0, 0), turn(0, 1, 0), describe=whole)
    found = around(truth, turn(0, 0, 0), turn(0, 1, 0), describe=brief, brief=True)
    assert brief.asked == [1] + [6, 1] * 4
    assert whole.asked[0] == 2
    assert len(whole.asked) > len(brief.asked)
    assert float(rotation_error(found.rotation[0], truth)) < 0.1


def test_parabolas_peak_where_they_do():
    """Scores 1 - sum (a_i - p_i)^2 / 100 of turns by a about the axes, in degrees."""
    p = torch.tensor([1.5, -2.0, 0.5], dtype=torch.float64)
    steps = torch.cat([5.0 * torch.eye(3), -5.0 * torch.eye(3)]).double()
    scores = (1.0 - (steps - p).square().sum(dim=1) / 100.0)[None]
    one = torch.zeros(1, dtype=torch.long)
    here = 1.0 - p.square().sum()[None] / 100.0
    state = Hypotheses(one, one, one, turn(0, 0, 0)[None], torch.ones(1).double(), here)
    torch.testing.assert_close(_peak(state, scores, torch.tensor([5.0]).double())[0], turn(*p.tolist()))
    beyond = scores.clone()
    beyond[0, 1] = -1.0  # +y lies out of reach: nothing is known of y
    expected = turn(float(p[0]), 0.0, float(p[2]))
    torch.testing.assert_close(_peak(state, beyond, torch.tensor([5.0]).double())[0], expected)


def test_the_distance_is_that_at_which_the_object_fills_its_box():
    K = camera_matrix(500.0, 500.0, 320.0, 240.0, dtype=torch.float64)
    truth, t = turn(20.0, 30.0, -10.0), torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    uv = project_points(CORNERS @ truth.T + t, torch.eye(4, dtype=torch.float64), K)
    box = torch.cat([uv.amin(dim=0), uv.amax(dim=0)])[None]
    found = around(truth, truth @ turn(4.0, -3.0, 2.0), boxes=box, camera_matrices=K[None])
    assert float(found.distance) == pytest.approx(4.0, rel=0.02)


def test_the_registrar_searches_with_its_box_and_camera(monkeypatch):
    image, box, T = scene(0)
    pipeline = replace(truck_bank().pipeline, contours=False)
    registrar = Registrar(truck_bank(), pipeline=pipeline)
    rounds = []
    monkeypatch.setattr(registrar_module, "search", lambda *a, brief, **k: rounds.append(brief) or search(*a, **k))
    result = registrar([image], box[None], CAMERA)[0]
    Registrar(truck_bank())([image], box[None], CAMERA)
    assert rounds == [False, True]
    centre = T[:3, :3] @ registrar.describers[0].centre + T[:3, 3]
    assert result.distance == pytest.approx(float(centre.norm()), rel=0.05)
    blind = registrar([image], box[None])[0].distance
    assert blind != pytest.approx(float(centre.norm()), rel=0.1)


def test_a_search_that_is_not_brief_needs_the_ranking():
    start = replace(around(turn(0, 0, 0), turn(1, 0, 0)), view=torch.zeros(1, dtype=torch.long))
    with pytest.raises(InvalidInputError, match="needs bank and ranking"):
        search([Turns()], torch.eye(3, dtype=torch.float64).view(1, 9), start, bank=truck_bank())


def test_a_round_that_finds_nothing_better_leaves_the_distance():
    """The first step of 5 degrees meets the truth, the second finds nothing better: rotation, score and distance stay
    those that belong together, the distance being the one at which the start filled the box."""
    K = camera_matrix(500.0, 500.0, 320.0, 240.0, dtype=torch.float64)
    start, truth = turn(0.0, 40.0, 0.0), turn(5.0, 0.0, 0.0) @ turn(0.0, 40.0, 0.0)
    box = torch.tensor([[260.0, 150.0, 380.0, 330.0]], dtype=torch.float64)
    filled = {name: pose_from_box(CORNERS, R, box[0], K) for name, R in (("start", start), ("truth", truth))}
    away = {name: float(t.norm()) for name, (_, t) in filled.items()}
    assert abs(away["start"] / away["truth"] - 1.0) > 0.001
    found = around(truth, start, boxes=box, camera_matrices=K[None])
    torch.testing.assert_close(found.rotation[0], truth)
    assert float(found.distance) == pytest.approx(away["start"], rel=1e-9)
