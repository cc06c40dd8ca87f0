"""Steps of the contour fit on edges at known distances along the normals."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from curvireg_torch.mesh import mesh_centre
from curvireg_torch.registration.contours.descent import ContourProblem, ContourState, apply_twist, project
from curvireg_torch.registration.contours.points import ContourPoints
from curvireg_torch.rendering import make_renderer
from tests.registration.contours.common import CUBE_POSE, K, cube, fitted, noise, pose, silhouette

CENTRE = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)
T = pose([0.3, -0.5, 0.2], [0.1, 0.2, 6.0])[None]


class ParabolicEdges:
    """Edges of given heights at (E, P) distances in px along the normals: parabolas 1.5 px wide to both sides."""

    def __init__(self, distances: Tensor, heights: list[float]) -> None:
        self.distances, self.heights = distances, torch.tensor(heights, dtype=torch.float64)

    def strength(self, uv: Tensor, normals: Tensor, offsets: Tensor, image_index: Tensor) -> Tensor:
        apart = (offsets - self.distances[:, :, None]) / 1.5
        return (self.heights[:, None, None] * (1.0 - apart**2).clamp(min=0.0)).sum(dim=0)[None]


def problem(distances: Tensor, heights: list[float]) -> ContourProblem:
    edges: Any = ParabolicEdges(distances, heights)
    return ContourProblem(None, edges, torch.tensor([0]), K[None], 128, CENTRE, 1.0)  # type: ignore[arg-type]


def state(count: int, valid: int | None = None) -> ContourState:
    generator = torch.Generator().manual_seed(0)
    model = CENTRE + 2.0 * torch.rand(1, count, 3, generator=generator, dtype=torch.float64) - 1.0
    normals = F.normalize(torch.randn(1, count, 2, generator=generator, dtype=torch.float64), dim=-1)
    mask = torch.arange(count)[None] < (count if valid is None else valid)
    return ContourState(T, T, ContourPoints(model, normals, mask, mask))


def at(count: int, *distances: float) -> Tensor:
    return torch.tensor(distances, dtype=torch.float64)[:, None].expand(-1, count)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_matches_take_the_nearer_edge_to_a_fraction_of_a_pixel(side):
    matches = problem(at(9, 1.2 * side, -2.0 * side), [0.5, 0.6]).matches(state(9, valid=7), 4.0)
    torch.testing.assert_close(matches.distance[0, :7, 0], torch.full((7,), 1.2 * side, dtype=torch.float64))
    strength = 0.5 * (1.0 - (0.2 / 1.5) ** 2)  # at the nearest whole pixel
    tukey = (1.0 - (1.2 / 4.0) ** 2) ** 2
    assert matches.weight[0, :, 0].tolist() == pytest.approx([strength * tukey] * 7 + [0.0] * 2)


@pytest.mark.parametrize(
    ("distances", "valid", "expected"),
    [
        (at(8, 0.0), 4, 0.7),
        (at(8, 1.0), 4, 0.7 * math.exp(-0.5)),
        (at(8, -3.0), 4, 0.7 * (1 - 1 / 2.25) * math.exp(-2.0)),
        (torch.tensor([[0.0, 50.0] * 4]).double(), 4, 0.35),
        (torch.tensor([[0.0, 50.0] * 4]).double(), 0, 0.0),
    ],
)
def test_edge_support_is_the_mean_strength_near_valid_points(distances, valid, expected):
    assert float(problem(distances, [0.7]).edge_support(state(8, valid=valid))) == pytest.approx(expected)


def test_step_undoes_a_motion_despite_stronger_wrong_edges():
    """Edges at the points of the moved object, and for every third point a stronger one 4 px beside it."""
    points = state(120).points
    motion = torch.tensor([0.006, -0.008, 0.01, 0.01, -0.015, 0.06], dtype=torch.float64)
    _, by_motion = project(points.model, T, K[None], CENTRE)
    distance = (points.normals[..., None, :] @ by_motion)[..., 0, :] @ motion
    assert float(distance.abs().max()) > 1.5
    sides = torch.where(torch.arange(120) % 2 == 0, 4.0, -4.0)
    wrong = torch.where(torch.arange(120) % 3 == 0, distance + sides, 90.0)
    step = problem(torch.cat([distance, wrong]), [0.5, 0.6])._solve(points, T, 6.0, None)[0]
    torch.testing.assert_close(step, motion, rtol=0.03, atol=1e-4)


def test_step_without_edges_is_zero():
    assert problem(at(30, 90.0), [1.0])._solve(state(30).points, T, 6.0, None)[0].tolist() == [0.0] * 6


@pytest.mark.parametrize(
    ("rotation", "translation", "fraction"),
    [([0.1, 0, 0], [0, 0, 0.05], 1.0), ([0, 0.3, 0.4], [0, 0, 0.01], 0.4), ([0.1, 0, 0], [0.3, 0, 0.4], 0.2)],
)
def test_long_steps_are_shortened(rotation, translation, fraction):
    """Translations are given as fractions of the distance."""
    z = float(T[0, 2, :3] @ CENTRE + T[0, 2, 3])
    step = torch.tensor([[*rotation, *(z * t for t in translation)]], dtype=torch.float64)
    torch.testing.assert_close(problem(at(1, 0.0), [1.0])._bounded(step, T), fraction * step)


def test_unfinished_starts_without_gain_come_back_unchanged() -> None:
    """On noise, where fits lead anywhere: one start is finished, and four others, all equal, gain nothing."""
    off = 0.3 * torch.randn(12, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    off[:4] = 0.0
    starts = apply_twist(CUBE_POSE.repeat(12, 1, 1), off, mesh_centre(cube()))
    unchanged = (fitted(noise(), starts, finish=1).transform == starts).all(dim=(1, 2))
    assert 3 <= int(unchanged.sum()) < 9


@pytest.mark.parametrize(("clear", "expected"), [(True, 1), (False, 2)], ids=["silhouette", "noise"])
def test_second_fit_continues_where_it_is_another_pose(clear, expected) -> None:
    """On a silhouette all rotations lead back to the true pose; on noise they lead elsewhere."""
    renderer, at_full_size = make_renderer(cube()), []

    def render(T: Tensor, K: Tensor, size: tuple[int, int]) -> Tensor:
        at_full_size.extend([len(T)] * (size[0] == 256))
        return renderer.render(T, K, size)

    counting = SimpleNamespace(name="counting", render=render)
    fitted(silhouette(cube(), CUBE_POSE) if clear else noise(), CUBE_POSE[None], renderer=counting)
    assert max(at_full_size) == expected
