"""Boxes and poses as the mouse, fingers and keys change them; no page is needed."""

import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_error
from curvireg_torch.viewer.session import dragged_box

BOX = (10.0, 20.0, 60.0, 50.0)


@pytest.mark.parametrize(
    ("box", "start", "end", "expected"),
    [
        (None, (60, 50), (10, 20.26), (10, 20.3, 60, 50)),
        (BOX, (200, 200), (201, 202), BOX),
        (BOX, (11, 35), (5, 99), (5, 20, 60, 50)),
        (BOX, (30, 19), (0, 25), (10, 25, 60, 50)),
        (BOX, (59, 51), (80, 90), (10, 20, 80, 90)),
        (BOX, (30, 35), (35, 25), (15, 10, 65, 40)),
        (BOX, (100, 100), (120, 130), (100, 100, 120, 130)),
        (BOX, (10, 35), (90, 35), (60, 20, 90, 50)),
        ((10, 10, 16, 16), (15.5, 13), (30, 13), (10, 10, 30, 16)),
    ],
    ids=["new", "click", "left", "top", "corner", "inside", "outside", "across", "small"],
)
def test_a_drag_draws_moves_and_resizes_boxes(box, start, end, expected):
    assert dragged_box(box, start, end, reach=4.0) == expected


@pytest.fixture
def pose(registered):
    """A result, its pose and camera, and the mesh's centre and radius."""
    shot = registered[0].shot
    return shot.result, *shot.result.registration.projection, shot.result.registrar.describer


def seen(T, K, point):
    at = K @ (T[:3, :3] @ point + T[:3, 3])
    return at[:2] / at[2]


def test_the_centre_follows_the_mouse_that_drags_the_mesh(pose):
    result, T, K, describer = pose
    moved = result.dragged(T, K, (100.0, 80.0), (112.0, 75.0), turns=False)
    shift = seen(moved, K, describer.centre) - seen(T, K, describer.centre)
    torch.testing.assert_close(shift, torch.tensor([12.0, -5.0], dtype=torch.float64))
    assert torch.equal(moved[:3, :3], T[:3, :3])


def test_the_near_side_follows_the_mouse_that_drags_beside_the_mesh(pose):
    result, T, K, describer = pose
    near = T[:3, :3].T @ torch.tensor([0, 0, -describer.radius], dtype=torch.float64) + describer.centre
    turned = result.dragged(T, K, (0.0, 0.0), (4.0, 3.0), turns=True)
    shift = seen(turned, K, near) - seen(T, K, near)
    assert 4 < shift[0] < 8, "right and down, a little more than the mouse, as it is nearer"
    assert 3 < shift[1] < 6
    torch.testing.assert_close(seen(turned, K, describer.centre), seen(T, K, describer.centre))


def test_wheel_and_twist_scale_and_roll_about_the_centre(pose):
    result, T, K, describer = pose
    moved = result.scaled(T, 1.25, roll=30.0)
    centres = [pose[:3, :3] @ describer.centre + pose[:3, 3] for pose in (T, moved)]
    torch.testing.assert_close(centres[1], centres[0] / 1.25)
    assert float(rotation_error(moved[:3, :3], T[:3, :3])) == pytest.approx(30, abs=1e-4)
    # Clockwise on the screen: what is right of the centre goes down.
    right = T[:3, :3].T @ torch.tensor([describer.radius, 0, 0], dtype=torch.float64) + describer.centre
    assert seen(moved, K, right)[1] > seen(T, K, right)[1]
    with pytest.raises(InvalidInputError, match="touch the camera"):
        result.scaled(T, 1000.0)
