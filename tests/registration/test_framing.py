"""What lies outside a photograph, and boxes that its border cuts."""

import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch.geometry import camera_matrix
from curvireg_torch.registration.framing import (
    border_sides,
    clipped,
    outside_fraction,
    outside_warnings,
)
from curvireg_torch.registration.inputs import image_item
from tests._support.scenes import CAMERA, SIZE, learned_registrar, scene

SQUARE = torch.from_numpy(trimesh.creation.box((1.0, 1.0, 0.001)).vertices.copy())
K = camera_matrix(100.0, 100.0, 49.5, 39.5, dtype=torch.float64)


def at(x: float, y: float, z: float) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([x, y, z])
    return T


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [(0.0, 0.0, 0.0), (1.0, 0.0, 0.5), (0.0, 0.8, 0.5), (-1.0, -0.8, 0.75), (9.0, 0.0, 1.0)],
)
def test_outside_fraction_of_a_square_of_50_px(x, y, expected):
    """In a photograph of 100 x 80 px: its middle on a border, in a corner, or far away."""
    assert outside_fraction(SQUARE, at(x, y, 2.0), K, (80, 100)) == pytest.approx(
        expected, abs=2e-3
    )


def test_outside_fraction_does_not_depend_on_the_unit_and_behind_the_camera_nothing_is_seen():
    for unit in (1e-3, 1e3):
        pose = at(unit, 0.0, 2.0 * unit)
        assert outside_fraction(unit * SQUARE, pose, K, (80, 100)) == pytest.approx(0.5, abs=2e-3)
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
    item = image_item(torch.rand(3, 80, 100), torch.tensor(box, dtype=torch.float32))
    assert (
        item.box.tolist() == list(part) == clipped(torch.tensor(box).double(), (80, 100)).tolist()
    )
    assert (
        border_sides(item.box, (80, 100))
        == border_sides(torch.tensor(box).double(), (80, 100))
        == sides
    )


def test_a_cut_object_has_a_warning_and_is_not_reliable():
    image, box, _ = scene(0)
    cut = int(box[0] + 0.6 * (box[2] - box[0]))
    part = image[:, :, :cut].contiguous()
    result = learned_registrar()([part], box[None], CAMERA)[0]
    features = result.confidence_features
    assert features["border"] == 1
    assert not result.reliable
    if features["outside"] >= 0.1:
        assert any("outside the photograph" in text for text in result.warnings)
    whole = learned_registrar()([image], box[None], CAMERA)[0].confidence_features
    assert (whole["border"], whole["outside"]) == (0, pytest.approx(0.0, abs=0.02))
    assert np.prod(SIZE) > part[0].numel()
