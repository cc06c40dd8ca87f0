"""Which of several fits counts: the one with the most support, by the weights of the mask."""

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.fitting import contour_fit
from curvireg_torch.fitting.contour_fit import COARSE_DENSITY, fit_to_edges
from curvireg_torch.fitting.contour_problem import ContourProblem, ContourState
from curvireg_torch.fitting.least_squares import apply_twist
from curvireg_torch.mesh.mesh import mesh_centre
from curvireg_torch.rendering.contours import MeshContours
from tests._support import double, eye
from tests.fitting.cube import CUBE_POSE, K, cube, cube_crops


def starts(*degrees):
    """Poses of the cube, turned about the y axis."""
    twist = torch.zeros(len(degrees), 6, dtype=torch.float64)
    twist[:, 1] = torch.deg2rad(double(degrees))
    return apply_twist(CUBE_POSE.repeat(len(degrees), 1, 1), twist, mesh_centre(cube()))


def fitted(monkeypatch, T, weigh, **options):
    """A fit to the cube where ``weigh`` gives the weighted support, from the plain one."""
    measure = ContourProblem.supports

    def supports(problem, state):
        plain, _ = measure(problem, state)
        return plain, weigh(problem, state, plain)

    monkeypatch.setattr(ContourProblem, "supports", supports)
    given = MeshContours(cube()), cube_crops(), K.expand(len(T), 3, 3), T
    index = torch.zeros(len(T), dtype=torch.long)
    return fit_to_edges(*given, index, short_fits=T, **options)


def test_the_weighted_support_decides_and_the_plain_one_is_reported(monkeypatch):
    """By these weights the start is better than all fits of it."""
    start = starts(6.0)
    fit = fitted(monkeypatch, start, lambda _, __, plain: 1.0 - plain)
    assert fit.transform.equal(start)
    assert float(fit.edge_support) == float(fit.start_support)
    fit = fitted(monkeypatch, start, lambda _, __, plain: plain)
    assert not fit.transform.equal(start)
    assert fit.edge_support > float(fit.start_support)


def test_the_starts_with_the_most_weighted_support_go_on(monkeypatch):
    """By these weights the last three."""
    begun = []
    went_on = []
    fit_at_half_size = contour_fit._fitted_at_half_size

    def weigh(problem, state, plain):
        if problem.density != COARSE_DENSITY:
            return 1.0 - plain
        begun.append(state.T)
        return torch.arange(len(plain)).double()

    def watched(half, T):
        went_on.append(T[0])
        fits, supports = fit_at_half_size(half, T)
        assert_close(supports[0], 1.0 - half.supports(fits)[0])
        return fits, supports

    monkeypatch.setattr(contour_fit, "_fitted_at_half_size", watched)
    fitted(monkeypatch, starts(6.0), weigh)
    assert went_on[0].equal(begun[0][[-1, -2, -3]])


def test_a_start_that_is_not_finished_has_its_fit_if_that_is_better_by_weight(monkeypatch):
    """Weights are a tenth of the plain support, which no fit reaches by weight."""
    given = starts(2.0, 6.0)

    def weigh(_, state, plain):
        near = (state.T - CUBE_POSE).flatten(1).norm(dim=1)
        return 0.1 * plain + torch.where(near < 1e-2, 0.01, 0.0)

    fit = fitted(monkeypatch, given, weigh, finish=1)
    moved = (fit.transform != given).flatten(1).any(dim=1)
    assert moved.tolist() == [True, True]


class Half:
    """A problem where poses shift by their x, and stay where they are."""

    def __getitem__(self, index):
        return self

    def mean_shift(self, points, before, after):
        return (after - before)[:, 0, 3].abs()

    def descend(self, state, radii):
        return state


@pytest.mark.parametrize(
    ("x", "support", "expected"),
    [
        ([0.0, 0.2, 0.6, 3.0], [0.9, 0.8, 0.5, 0.6], [0.0, 3.0]),
        ([0.0, 0.2, 0.6, 3.0], [0.9, 0.8, 0.7, 0.6], [0.0, 0.6]),
        ([0.0, 0.2, 0.4, 0.45], [0.9, 0.8, 0.7, 0.6], [0.0]),
        ([3.0, 0.2, 0.0, 0.45], [0.7, 0.8, 0.9, 0.6], [0.0, 3.0]),
    ],
)
def test_the_next_best_fit_is_another_pose(x, support, expected):
    T = eye(4).repeat(4, 1, 1)
    T[:, 0, 3] = double(x)
    points = torch.zeros(4, 1)
    fits = ContourState(T, T, points)
    half = Half()
    index = torch.zeros(1, dtype=torch.long)
    supports = double([support])
    source, chosen = contour_fit._two_best(half, fits, supports, index)
    assert chosen[:, 0, 3].tolist() == pytest.approx(expected)
    assert source.tolist() == [0] * len(expected)
