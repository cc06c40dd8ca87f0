import numpy as np
import pytest
import torch

from curvireg_torch.visualization.contours import contour_layer

FOCAL, SIZE = 200.0, 120
CAMERA = torch.tensor([[FOCAL, 0.0, 59.5], [0.0, FOCAL, 59.5], [0.0, 0.0, 1.0]])
GREEN, ORANGE = (0, 255, 80), (255, 170, 0)


def facing(slope_left, slope_right):
    """Depth of two planes that meet in the vertical ridge x = 0, z = 5: z = 5 + slope x, seen in a square."""
    x = (torch.arange(SIZE) - 59.5) / FOCAL
    slope = torch.where(x < 0, slope_left, slope_right)
    depth = (5.0 / (1.0 - slope * x)).expand(SIZE, SIZE).clone()
    depth[:15], depth[-15:], depth[:, :15], depth[:, -15:] = 0, 0, 0, 0
    return depth


def colour(layer, value):
    return (layer[..., :3] == value).all(axis=2) & (layer[..., 3] == 255)


def test_contour_layer_outlines_a_square():
    layer = contour_layer(facing(0.0, 0.0), CAMERA)
    rows, columns = np.nonzero(colour(layer, GREEN))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (15, 104, 15, 104)
    assert not layer[25:95, 25:95].any(), "nothing inside a plane"
    alpha = layer[60, :, 3]
    assert ((alpha > 0) & (alpha < 255)).any(), "anti-aliased"
    rim = layer[60, 13]
    assert rim[3] > 60
    assert rim[:3].max() < 200, "darker than the line"
    assert not layer[:10].any()


@pytest.mark.parametrize("transpose", [False, True])
@pytest.mark.parametrize(("degrees", "drawn"), [(20, False), (40, True)])
def test_contour_layer_draws_creases_of_more_than_25_degrees(degrees, drawn, transpose):
    slope = float(np.tan(np.deg2rad(degrees / 2)))
    for depth in (facing(-slope, slope), facing(slope, -slope), facing(0.0, float(np.tan(np.deg2rad(degrees))))):
        layer = contour_layer(depth.mT.contiguous() if transpose else depth, CAMERA)
        crease = colour(layer.transpose(1, 0, 2) if transpose else layer, ORANGE)[30:90, 20:100]
        assert bool(crease.any()) == drawn
        if drawn:
            assert crease.any(axis=1).all(), "without a gap"
            assert set(np.nonzero(crease)[1] + 20) <= {58, 59, 60, 61}


def test_contour_layer_draws_occluding_edges_but_no_steep_plane():
    step = facing(0.0, 0.0)
    step[15:105, 60:105] = 5.5
    orange = colour(contour_layer(step, CAMERA), ORANGE)[30:90]
    assert orange.any(axis=1).all()
    assert set(np.nonzero(orange)[1]) <= {58, 59, 60, 61}
    assert not colour(contour_layer(facing(3.0, 3.0), CAMERA), ORANGE).any()


def test_the_outline_is_drawn_over_the_creases_that_end_at_it():
    slope = float(np.tan(np.deg2rad(20)))
    layer = contour_layer(facing(-slope, slope), CAMERA)
    assert colour(layer, ORANGE)[30:90, 58:62].any(axis=1).all()
    for row in (15, 104):
        assert colour(layer, GREEN)[row, 15:105].all(), "without a gap where the crease ends"
