"""Feature points in cells: shares are those of average pooling, to the bit; every point counts once."""

from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F

from curvireg_torch.terms.repeatability import Repeatability, cell_shares


@pytest.mark.parametrize(("size", "cell"), [(128, 2), (64, 1), (65, 2), (100, 3), (1030, 16)])
def test_shares_are_those_of_average_pooling(size, cell):
    points = torch.rand(3, size, size, generator=torch.Generator().manual_seed(0)) < 0.3
    points[1] = True
    expected = F.avg_pool2d(points[:, None].float(), cell, ceil_mode=True)[:, 0]
    assert torch.equal(cell_shares(points, cell), expected)


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
    term = Repeatability().over(OneView(size))
    assert term.cell == cell
    assert term(SimpleNamespace(points=points)).item() == 0.5
