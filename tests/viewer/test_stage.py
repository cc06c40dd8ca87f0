"""The photograph, the steps and the fields of the page, without a browser."""

import asyncio
from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

from curvireg_torch.evaluation.opening import RegisterOptions
from curvireg_torch.viewer.session import Session
from curvireg_torch.viewer.workspace import Workspace
from tests.viewer.test_session import write_scene


@pytest.fixture
def workspace(tmp_path):
    write_scene(tmp_path)
    workspace = Workspace(Session(RegisterOptions()), tmp_path / "page")
    asyncio.run(workspace.open_photo(tmp_path / "photo.png", "photo.png"))  # 240 x 180 px
    return workspace


@pytest.fixture
def build(workspace):
    """Builds a part of the page of the workspace, which no browser shows."""
    from nicegui.client import Client
    from nicegui.page import page

    with Client(page(""), request=None):
        yield lambda part: part(workspace)


def send(stage, kind, x=0.0, y=0.0, **values):
    stage._handle(SimpleNamespace(args={"type": kind, "x": x, "y": y, "reach": 4 / 240, **values}))


def drag(stage, start, end):
    for kind, (x, y) in (("press", start), ("move", end), ("release", end)):
        send(stage, kind, (x + 0.5) / 240, (y + 0.5) / 180)


def test_gestures_come_as_fractions_and_become_a_box_in_px(workspace, build):
    from curvireg_torch.viewer.stage import Stage

    session, stage = workspace.session, build(Stage)
    drag(stage, (20, 30), (120, 90))
    assert session.box == pytest.approx((20, 30, 120, 90))
    drag(stage, (122, 60), (150, 60))  # the right edge, which is near enough
    assert session.box == pytest.approx((20, 30, 150, 90))
    send(stage, "nudge", dx=-2, dy=1, resize=False)
    assert session.box == pytest.approx((18, 31, 148, 91))
    send(stage, "nudge", dx=3, dy=0, resize=True)
    assert session.box == pytest.approx((18, 31, 151, 91))
    for kind, box in (("undo", (18, 31, 148, 91)), ("undo", (20, 30, 150, 90)), ("redo", (18, 31, 148, 91))):
        send(stage, kind)
        assert session.box == pytest.approx(box)
    send(stage, "press", 0.1, 0.1)
    send(stage, "move", 0.9, 0.9)
    send(stage, "cancel")
    send(stage, "release")
    assert session.box == pytest.approx((18, 31, 148, 91))
    assert stage.shapes.content.count("<rect") == 2
    assert "viewBox='-0.5 -0.5 240 180'" in stage.shapes.content
    send(stage, "remove")
    assert session.box is None
    assert "<rect" not in stage.shapes.content


def test_a_click_on_a_dashed_box_chooses_it(workspace, build, monkeypatch):
    from curvireg_torch.viewer.stage import Stage

    proposals = [[10.04, 20, 60, 70], [100, 20, 160, 70]]
    monkeypatch.setattr(workspace.session, "proposals", lambda: proposals)
    stage = build(Stage)
    drag(stage, (200, 150), (200, 150))
    assert workspace.session.box is None
    assert stage.shapes.content.count("stroke-dasharray='4 6'") == 4
    drag(stage, (130, 40), (130, 40))
    assert workspace.session.box == (100, 20, 160, 70)


def test_steps_tick_off_and_say_what_is_missing(workspace, build):
    from curvireg_torch.viewer.steps import Steps

    steps = build(Steps)

    def done():
        steps.refresh()
        return [name for name, card in steps.cards.items() if "done" in card.classes]

    assert done() == ["photograph"]
    assert steps.facts["photograph"].content == "photo.png: 240 x 180 px"
    assert "disabled" in steps.find.props
    workspace.messages["mesh"] = "a.ply: <b>empty</b>"
    asyncio.run(workspace.open_mesh(workspace.folder.parent / "truck.ply", "truck.ply"))
    workspace.messages["mesh"] = "a.ply: <b>empty</b>"
    assert done() == ["photograph", "mesh"]
    assert steps.messages["mesh"].content == "a.ply: &lt;b&gt;empty&lt;/b&gt;", "text, not HTML"
    assert "disabled" not in steps.find.props
    assert steps.find.content == "Find the object and its pose"
    workspace.set_box((10.0, 20.0, 60.0, 70.0))
    assert done() == ["photograph", "mesh", "box"]
    assert steps.find.content == "Find the pose"


def test_typed_numbers_become_one_change_of_the_box(workspace, build):
    from curvireg_torch.viewer.inputs import Inputs

    inputs, session = build(Inputs), workspace.session
    workspace.set_box((10.0, 20.0, 60.0, 70.0))
    inputs.refresh()
    assert [number.value for number in inputs.box] == [10, 20, 60, 70]
    workspace.set_box((15.0, 25.0, 65.0, 75.0))
    inputs.refresh()
    inputs.box[2].set_value(90)
    assert session.box == (15, 25, 90, 75)
    for box in ((15, 25, 65, 75), (10, 20, 60, 70), None):
        workspace.drawing.undo()
        assert workspace.drawing.box == box
    inputs.camera[0].set_value(300)
    assert session.camera is None, "not before all four are there"
    for number, value in zip(inputs.camera[1:], (300, 119.5, 89.5), strict=True):
        number.set_value(value)
    assert session.camera == (300, 300, 119.5, 89.5)
    inputs.refresh()
    inputs.fov.set_value(65)
    assert (session.camera, session.fov) == (None, 65)
    inputs.refresh()
    assert [number.value for number in inputs.camera] == [None] * 4
