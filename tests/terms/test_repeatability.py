import math
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.terms import Repeatability, dilate_points, repeatability, repeatability_score, terms
from curvireg_torch.terms.scores import cell_counts


@pytest.mark.parametrize("eps", [0.0, 1.0, 2.0, 2.5, 2.9, 3.0, 4.0])
def test_dilate_points_uses_a_euclidean_disc(eps):
    points = torch.rand(3, 31, 40, generator=torch.Generator().manual_seed(0)) < 0.02
    points[0] = False
    dilated = dilate_points(points, eps)
    assert not bool(dilated[0].any())
    for plane, expected in zip(dilated[1:], points[1:], strict=True):
        assert (plane.numpy() == (distance_transform_edt(~expected.numpy()) <= eps)).all()


def test_repeatability_equals_a_loop():
    generator = torch.Generator().manual_seed(1)
    query = torch.rand(2, 12, 12, generator=generator) < 0.2
    views = torch.rand(3, 12, 12, generator=generator) < 0.1
    views[2] = False
    found = repeatability(query, dilate_points(views, 1.5))
    for b in range(2):
        for n in range(3):
            distances = torch.cdist(query[b].nonzero().float(), views[n].nonzero().float())
            near = (distances <= 1.5).any(dim=1).float()
            assert float(found[b, n]) == pytest.approx(float(near.mean()))


def test_repeatability_score_has_the_closed_form():
    rep = torch.tensor([[0.2, 0.5, 0.8]])
    assert int(repeatability_score(rep).argmax()) == 2
    assert int(repeatability_score(rep, mode="paper").argmax()) == 1  # the paper's formula favours average views
    for sigma in (0.1, 0.2):
        expected = [math.exp(-(d**2) / (2 * sigma**2)) for d in (0.6, 0.3, 0.0)]
        torch.testing.assert_close(repeatability_score(rep, sigma=sigma)[0], torch.tensor(expected))
    with pytest.raises(InvalidInputError, match="mode"):
        repeatability_score(rep, mode="other")


@pytest.mark.parametrize(("size", "cell"), [(128, 2), (64, 1), (65, 2), (100, 3), (1030, 16)])
def test_cell_counts_equal_average_pooling(size, cell):
    points = torch.rand(3, size, size, generator=torch.Generator().manual_seed(0)) < 0.3
    points[1] = True
    expected = F.avg_pool2d(points[:, None].double(), cell, ceil_mode=True)[:, 0]
    counts = cell_counts(points, cell)
    torch.testing.assert_close(counts / counts[1].double(), expected)
    assert int(counts[1, 0, 0]) == cell**2


class PointViews:
    """Views of ``size`` px; view i has feature points at the (row, column) indices ``points[i]``."""

    def __init__(self, size, *points):
        self.settings = SimpleNamespace(image_size=size)
        self.points, self.descriptors = torch.zeros(len(points), size, size, dtype=torch.bool), torch.zeros(1)
        for view, (rows, columns) in zip(self.points, points, strict=True):
            view[rows, columns] = True

    def __len__(self):
        return len(self.points)

    def points_at(self, index):
        return self.points[index]


@pytest.mark.parametrize(("size", "cell"), [(129, 2), (194, 3)])
def test_repeatability_counts_points_in_cut_cells_once(size, cell):
    """One point in the cut corner, one at a cut side, two in whole cells; the view's points fill the last column."""
    assert 0 < size % cell < cell
    term = Repeatability().build(PointViews(size, (slice(None), -1)))
    assert term.cell == cell
    query = PointViews(size, ([size - 1, 0, 0, 2 * cell], [size - 1, size - 1, 0, cell])).points[None]
    assert term(SimpleNamespace(points=query)).item() == 0.5


@pytest.mark.parametrize("size", [64, 128, 256])
def test_repeatability_resolves_eps_with_64_cells_per_side(size):
    """A point 3 px nearer than eps matches, and one 4 px farther does not."""
    eps = 0.1
    middle, distance = size // 2, int(eps * size)
    views = PointViews(size, *((middle, middle + distance + d) for d in (-3, 4)))
    term = Repeatability(eps=eps).build(views)
    assert term.near.shape == (2, 64**2)
    query = PointViews(size, (middle, middle)).points[None]
    assert term(SimpleNamespace(points=query)).tolist() == [[1.0, 0.0]]


@pytest.mark.parametrize("threads", [1, 3])
def test_repeatability_keeps_views_of_several_chunks_in_order(threads):
    count, before = 2 * terms.VIEWS_AT_A_TIME + 3, torch.get_num_threads()
    views = PointViews(64, *((i // 64, i % 64) for i in range(count)))
    torch.set_num_threads(threads)
    near = Repeatability(eps=0.016).build(views).near
    torch.set_num_threads(before)
    assert torch.equal(near, dilate_points(views.points, 1.0).flatten(1).to(near.dtype))


@pytest.mark.parametrize(("eps", "side"), [(0.016, 64), (0.008, 128)])
def test_repeatability_cells_are_at_most_eps(eps, side):
    assert Repeatability(eps=eps).build(PointViews(128, (64, 64))).near.shape[1] == side**2
