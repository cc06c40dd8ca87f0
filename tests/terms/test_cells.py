"""Feature points are counted in cells as average pooling does, to the bit."""

import pytest
import torch
import torch.nn.functional as F

from curvireg_torch.terms.repeatability import cell_shares


@pytest.mark.parametrize(("size", "cell"), [(128, 2), (64, 1), (65, 2), (100, 3), (1030, 16)])
def test_shares_are_those_of_average_pooling(size, cell):
    points = torch.rand(3, size, size, generator=torch.Generator().manual_seed(0)) < 0.3
    points[1] = True
    expected = F.avg_pool2d(points[:, None].float(), cell, ceil_mode=True)[:, 0]
    assert torch.equal(cell_shares(points, cell), expected)
