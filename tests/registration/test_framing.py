"""What lies outside a photograph, and boxes that its border cuts."""

import pytest
import torch
import trimesh
from torch.testing import assert_close

from curvireg_torch.geometry import camera_matrix
from curvireg_torch.geometry.framing import (
    CropFrame,
    border_sides,
    clipped,
    inside_boxes,
    outside_fraction,
    photograph_box,
    shown_in,
    whole_boxes,
)
from curvireg_torch.registration.judging import outside_warnings
from curvireg_torch.registration.photograph import as_photograph
from tests._support import answer_of, degrees_off, double, eye, learned_registrar, scene, slow_after

SQUARE = torch.from_numpy(trimesh.creation.box((1.0, 1.0, 0.001)).vertices.copy())
K = camera_matrix(100.0, 100.0, 49.5, 39.5)


def at(x, y, z):
    T = eye(4)
    T[:3, 3] = torch.tensor([x, y, z])
    return T


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [(0.0, 0.0, 0.0), (1.0, 0.0, 0.5), (0.0, 0.8, 0.5), (-1.0, -0.8, 0.75), (9.0, 0.0, 1.0)],
)
def test_outside_fraction_of_a_square_of_50_px(x, y, expected):
    """In a photograph of 100 x 80 px: its middle on a border, in a corner, or far away."""
    for unit in (1.0, 1e-3, 1e3):
        pose = at(unit * x, unit * y, unit * 2.0)
        fraction = outside_fraction(unit * SQUARE, pose, K, (80, 100))
        assert fraction == pytest.approx(expected, abs=2e-3)


def test_behind_the_camera_nothing_is_seen():
    assert outside_fraction(SQUARE, at(0.0, 0.0, -1.0), K, (80, 100)) == 1.0


def test_warnings_begin_at_a_tenth():
    assert outside_warnings(0.09) == ()
    (text,) = outside_warnings(0.244)
    assert "24 % of the object lies outside the photograph" in text


@pytest.mark.parametrize(
    ("box", "part", "sides"),
    [
        ((10, 20, 30, 40), (10, 20, 30, 40), 0),
        ((-30, 20, 30, 40), (-0.5, 20, 30, 40), 1),
        ((10, -9, 300, 99), (10, -0.5, 99.5, 79.5), 3),
        ((0, 20, 30, 40), (0, 20, 30, 40), 1),
        ((2, 20, 30, 40), (2, 20, 30, 40), 0),
    ],
)
def test_boxes_are_clipped_to_the_photograph(box, part, sides):
    item = as_photograph(torch.rand(3, 80, 100), torch.tensor(box, dtype=torch.float32))
    assert item.box.tolist() == list(part) == clipped(double(box), (80, 100)).tolist()
    assert border_sides(item.box, (80, 100)) == border_sides(double(box), (80, 100)) == sides


def test_whole_boxes_go_on_beyond_the_border_alone():
    size = (100, 200)
    inside = torch.tensor([10.0, 20.0, 60.0, 50.0])
    assert whole_boxes(inside, size) == []
    corner = torch.tensor([150.0, 60.0, 199.5, 99.5])
    near, far = whole_boxes(corner, size)
    expected = torch.tensor([150.0, 60.0, 199.5 + 0.4 * 49.5, 99.5 + 0.4 * 39.5])
    assert_close(near, expected)
    assert (far - corner).tolist() == pytest.approx([0.0, 0.0, 1.2 * 49.5, 1.2 * 39.5], abs=1e-4)
    across = torch.tensor([-0.5, 20.0, 199.5, 50.0])
    wide = whole_boxes(across, size)[0]
    assert (wide - across).tolist() == pytest.approx([-40.0, 0.0, 40.0, 0.0])


def test_frame_knows_what_of_a_crop_lies_in_the_photograph():
    # a square of 80 px without margin that goes on for 20 px to the left and 30 px below
    box = torch.tensor([-20.5, 49.5, 59.5, 129.5])
    frame = CropFrame.of(box, photograph_box((100, 200)), side=16, margin=0.0)
    corners = double([[-20.5, 49.5, 1.0], [59.5, 129.5, 1.0]])
    expected = double([[-0.5, -0.5, 1.0], [15.5, 15.5, 1.0]])
    assert_close(corners @ frame.transform.T, expected)
    columns = torch.arange(16) >= 4
    rows = torch.arange(16) < 10
    assert frame.inside.equal((rows[:, None] & columns)[None])
    field = torch.ones(1, 2, 16, 16)
    assert float(shown_in(frame, field).sum()) == 2 * 10 * 12
    assert shown_in(None, field) is field


@pytest.mark.parametrize("seed", slow_after(1, [9, 11]))
def test_half_of_an_object_at_the_border_gives_its_pose(seed):
    image, box, T = scene(seed)
    end = int(0.5 * (box[0] + box[2]))
    visible = torch.tensor([box[0], box[1], end - 0.5, box[3]])
    result = answer_of(learned_registrar(), image[..., :end], visible)
    assert degrees_off(result, T) < 10.0
    features = result.confidence_features
    assert (features["border"], features["outside"]) == (1, pytest.approx(0.5, abs=0.15))
    assert any("outside the photograph" in text for text in result.warnings)
    assert not result.reliable


def test_pixels_of_a_crop_count_from_the_first_to_the_last_one_of_a_box():
    """Pixel k of a crop of 64 px is pixel k + 10 of the photograph."""
    shown = torch.tensor([[20.0, 30.0, 60.0, 71.0], [20.4, 30.4, 59.6, 70.6]])
    boxes = double([9.5, 9.5, 73.5, 73.5]).expand(2, 4)
    expected = torch.zeros(2, 1, 64, 64)
    expected[0, 0, 20:62, 10:51] = 1.0
    expected[1, 0, 21:61, 11:50] = 1.0
    assert torch.equal(inside_boxes(shown, boxes, 64, 0.0), expected)
    frame = CropFrame.of(boxes[0], shown[0], side=64, margin=0.0)
    assert torch.equal(frame.inside, expected[0] > 0)
