import pytest

from curvireg_torch.viewer.drawing import BoxDrawing


def drag(drawing, start, *points, reach=4.0):
    drawing.press(*start, reach=reach)
    for point in points:
        drawing.move(*point)
    drawing.release()
    return drawing.box


def test_drag_draws_a_box_in_any_direction():
    assert drag(BoxDrawing(), (60, 50), (10, 20)) == (10, 20, 60, 50)
    assert drag(BoxDrawing(), (10, 50), (30, 30), (60, 20.26)) == (10, 20.3, 60, 50)


@pytest.mark.parametrize(
    ("start", "end", "box"),
    [
        ((11, 35), (5, 99), (5, 20, 60, 50)),
        ((60, 35), (70, 0), (10, 20, 70, 50)),
        ((30, 19), (0, 25), (10, 25, 60, 50)),
        ((30, 52), (0, 45), (10, 20, 60, 45)),
        ((12, 21), (0, 0), (0, 0, 60, 50)),
        ((59, 51), (80, 90), (10, 20, 80, 90)),
        ((30, 35), (35, 25), (15, 10, 65, 40)),
        ((100, 100), (120, 130), (100, 100, 120, 130)),
        ((10, 35), (90, 35), (60, 20, 90, 50)),
    ],
    ids=["left", "right", "top", "bottom", "corner", "other corner", "inside", "outside", "across"],
)
def test_drag_moves_edges_corners_and_the_box(start, end, box):
    assert drag(BoxDrawing((10, 20, 60, 50)), start, end) == box


def test_click_changes_nothing():
    assert drag(BoxDrawing((10, 20, 60, 50)), (200, 200), (201, 202)) == (10, 20, 60, 50)
    assert drag(BoxDrawing(), (5, 5)) is None
    drawing = BoxDrawing((10, 20, 60, 50))
    drawing.move(0, 0)  # without the button
    drawing.release()
    assert drawing.box == (10, 20, 60, 50)


def test_drag_takes_the_nearer_edge_of_a_small_box():
    assert drag(BoxDrawing((10, 10, 16, 16)), (15.5, 13), (30, 13), reach=8) == (10, 10, 30, 16)


def test_undo_and_redo_go_through_the_changes_of_the_box():
    drawing = BoxDrawing()
    drag(drawing, (10, 20), (60, 50))
    drawing.press(30, 30, reach=4)  # a click changes nothing
    drawing.release()
    drawing.nudge(2, -3)
    drawing.nudge(5, 1, resize=True)
    assert drawing.box == (12, 17, 67, 48)
    boxes = []
    while drawing.can_undo:
        drawing.undo()
        boxes.append(drawing.box)
    assert boxes == [(12, 17, 62, 47), (10, 20, 60, 50), None]
    drawing.undo()
    drawing.redo()
    assert drawing.box == (10, 20, 60, 50)
    drawing.set((1, 2, 30, 40))
    assert not drawing.can_redo, "a new change ends what can be repeated"
    drawing.undo()
    assert drawing.box == (10, 20, 60, 50)


def test_cancel_brings_back_the_box_of_before_the_drag():
    drawing = BoxDrawing((10, 20, 60, 50))
    drawing.press(60, 35, reach=4)
    drawing.move(90, 35)
    drawing.cancel()
    drawing.release()
    assert drawing.box == (10, 20, 60, 50)
    assert not drawing.can_undo


def test_nudge_keeps_a_least_size_and_needs_a_box():
    drawing = BoxDrawing((10, 20, 15, 50))
    drawing.nudge(-10, 0, resize=True)
    assert drawing.box == (10, 20, 13, 50)
    drawing = BoxDrawing()
    drawing.nudge(1, 1)
    assert drawing.box is None
