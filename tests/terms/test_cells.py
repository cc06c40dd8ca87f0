"""Feature points in cells: shares are those of average pooling, to the bit; every point counts once."""

from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F

from curvireg_torch.terms.repeatability import Repeatability, cell_fractions


@pytest.mark.parametrize(("size", "cell"), [(128, 2), (64, 1), (65, 2), (100, 3), (1030, 16)])
def test_shares_are_those_of_average_pooling(size, cell):
    points = torch.rand(3, size, size, generator=torch.Generator().manual_seed(0)) < 0.3
    points[1] = True
    expected = F.avg_pool2d(points[:, None].float(), cell, ceil_mode=True)[:, 0]
    assert torch.equal(cell_fractions(points, cell), expected)


class OneView:
    """A view whose points lie in the last column of a picture."""

    def __init__(self, size):
        self.settings = SimpleNamespace(image_size=size)

    def __len__(self):
        return 1

    def points_at(self, which):
        points = torch.zeros(1, self.settings.image_size, self.settings.image_size, dtype=torch.bool)
        points[0, :, -1] = True
        return points[which]


@pytest.mark.parametrize(("size", "cell"), [(129, 2), (194, 3)])
def test_a_point_in_a_cut_cell_counts_once(size, cell):
    """One point in the cut corner, one in a cut side, two in whole cells."""
    assert 0 < size % cell < cell
    points = torch.zeros(1, 1, size, size, dtype=torch.bool)
    for y, x in ((size - 1, size - 1), (0, size - 1), (0, 0), (2 * cell, cell)):
        points[..., y, x] = True
    term = Repeatability().build(OneView(size))
    assert term.cell == cell
    assert term(SimpleNamespace(points=points)).item() == 0.5


class OnePoint:
    """Views of S px, each with one point in the middle row, at the given columns."""

    def __init__(self, side, columns):
        self.settings = SimpleNamespace(image_size=side)
        self.points = torch.zeros(len(columns), side, side, dtype=torch.bool)
        self.points[range(len(columns)), side // 2, columns] = True

    def __len__(self):
        return len(self.points)

    def points_at(self, index):
        return self.points[index]


@pytest.mark.parametrize(("side", "cells"), [(64, 64), (128, 64), (256, 64)])
def test_points_are_counted_in_64_cells_a_side_however_far_they_may_be_apart(side, cells):
    """A point 3 px nearer than eps is found and one 3 px farther is not: a cell is small beside eps."""
    eps = 0.1
    away = int(eps * side)
    views = OnePoint(side, [side // 2 + away - 3, side // 2 + away + 4])
    term = Repeatability(eps=eps).build(views)
    assert term.near.shape == (2, cells**2)
    query = OnePoint(side, [side // 2]).points[None]
    assert term(SimpleNamespace(points=query)).tolist() == [[1.0, 0.0]]


def test_cells_are_never_larger_than_eps():
    """2 px at 128 px allow cells of 2 px, 1 px allows pixels alone."""
    sides = [Repeatability(eps=eps).build(OnePoint(128, [64])).near.shape[1] ** 0.5 for eps in (0.016, 0.008)]
    assert sides == [64, 128]
