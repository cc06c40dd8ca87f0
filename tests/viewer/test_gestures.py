"""Boxes and poses as the mouse, fingers and keys change them; no page is needed."""

import pytest
import torch

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_error
from curvireg_torch.viewer.gestures import BoxDrawing, PoseDrag


def drag(drawing, start, *points, reach=4.0):
    drawing.press(*start, reach=reach)
    for point in points:
        drawing.move(*point)
    drawing.release()
    return drawing.box


def test_drag_draws_a_box_in_any_direction_and_a_click_changes_nothing():
    assert drag(BoxDrawing(), (60, 50), (10, 20)) == (10, 20, 60, 50)
    assert drag(BoxDrawing(), (10, 50), (30, 30), (60, 20.26)) == (10, 20.3, 60, 50)
    assert drag(BoxDrawing((10, 20, 60, 50)), (200, 200), (201, 202)) == (10, 20, 60, 50)
    assert drag(BoxDrawing(), (5, 5)) is None
    drawing = BoxDrawing((10, 20, 60, 50))
    drawing.move(0, 0)  # without the button
    assert drawing.box == (10, 20, 60, 50)


@pytest.mark.parametrize(
    ("start", "end", "box"),
    [
        ((11, 35), (5, 99), (5, 20, 60, 50)),
        ((30, 19), (0, 25), (10, 25, 60, 50)),
        ((59, 51), (80, 90), (10, 20, 80, 90)),
        ((30, 35), (35, 25), (15, 10, 65, 40)),
        ((100, 100), (120, 130), (100, 100, 120, 130)),
        ((10, 35), (90, 35), (60, 20, 90, 50)),
    ],
    ids=["left", "top", "corner", "inside", "outside", "across"],
)
def test_drag_moves_edges_corners_and_the_box(start, end, box):
    assert drag(BoxDrawing((10, 20, 60, 50)), start, end) == box


def test_drag_takes_the_nearer_edge_of_a_small_box():
    assert drag(BoxDrawing((10, 10, 16, 16)), (15.5, 13), (30, 13), reach=8) == (10, 10, 30, 16)


def test_undo_takes_back_the_last_change_and_repeats_it():
    drawing = BoxDrawing()
    drag(drawing, (10, 20), (60, 50))
    drawing.press(30, 30, reach=4)  # a click changes nothing
    drawing.release()
    drawing.nudge(2, -3)
    drawing.nudge(5, 1, resize=True)
    assert drawing.box == (12, 17, 67, 48)
    for box in ((12, 17, 62, 47), (12, 17, 67, 48)):
        drawing.undo()
        assert drawing.box == box
    drawing.press(12, 17, reach=4)
    drawing.move(0, 0)
    drawing.cancel()
    drawing.release()
    assert drawing.box == (12, 17, 67, 48)
    drawing.nudge(-100, 0, resize=True)
    assert drawing.box == (12, 17, 15, 48), "a least size"


@pytest.fixture
def pose(registered):
    """A drag of the pose of a result, its camera and the mesh's centre."""
    session = registered[0]
    T, K = session.result.registration.projection
    return PoseDrag(session.result, T, K), K, session.result.registrar.describer


def seen(T, K, point):
    at = K @ (T[:3, :3] @ point + T[:3, 3])
    return at[:2] / at[2]


def test_the_centre_follows_the_mouse_that_drags_the_mesh(pose):
    drag, K, describer = pose
    before = drag.T
    drag.press(100.0, 80.0, turns=False)
    drag.drag(300.0, 10.0)
    drag.drag(112.0, 75.0)  # what counts is where it is, not the way
    drag.release()
    drag.drag(0.0, 0.0)
    shift = seen(drag.T, K, describer.centre) - seen(before, K, describer.centre)
    torch.testing.assert_close(shift, torch.tensor([12.0, -5.0], dtype=torch.float64))
    assert torch.equal(drag.T[:3, :3], before[:3, :3])


def test_the_near_side_follows_the_mouse_that_drags_beside_the_mesh(pose):
    drag, K, describer = pose
    before = drag.T
    near = before[:3, :3].T @ torch.tensor([0, 0, -describer.radius], dtype=torch.float64) + describer.centre
    drag.press(0.0, 0.0, turns=True)
    drag.drag(4.0, 3.0)
    shift = seen(drag.T, K, near) - seen(before, K, near)
    assert 4 < shift[0] < 8, "right and down, a little more than the mouse, as it is nearer"
    assert 3 < shift[1] < 6
    torch.testing.assert_close(seen(drag.T, K, describer.centre), seen(before, K, describer.centre))


def test_wheel_and_twist_scale_and_roll_about_the_centre(pose):
    drag, K, describer = pose
    before = drag.T
    drag.scale(1.25)
    centres = [T[:3, :3] @ describer.centre + T[:3, 3] for T in (before, drag.T)]
    torch.testing.assert_close(centres[1], centres[0] / 1.25)
    drag.move(rotation=(0, 0, 30))
    torch.testing.assert_close(seen(drag.T, K, describer.centre), seen(before, K, describer.centre))
    assert float(rotation_error(drag.T[:3, :3], before[:3, :3])) == pytest.approx(30, abs=1e-4)
    # Clockwise on the screen: what is right of the centre goes down.
    right = before[:3, :3].T @ torch.tensor([describer.radius, 0, 0], dtype=torch.float64) + describer.centre
    assert seen(drag.T, K, right)[1] > seen(before, K, right)[1]
    T = drag.T
    with pytest.raises(InvalidInputError, match="touch the camera"):
        drag.scale(1000.0)
    assert drag.T is T
