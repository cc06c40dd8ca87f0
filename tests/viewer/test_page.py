import asyncio
from dataclasses import replace
from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

from nicegui.client import Client
from nicegui.page import page

from curvireg_torch.geometry import Camera
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.viewer.page import Steps
from curvireg_torch.viewer.side import Answers, Inputs, Preview
from curvireg_torch.viewer.stage import Stage
from curvireg_torch.viewer.workspace import Workspace
from tests.viewer.test_session import write_scene


@pytest.fixture
def workspace(tmp_path):
    write_scene(tmp_path)
    workspace = Workspace(RegisterOptions(limits={"front": "-x", "theta": (-10.0, 10.0)}), tmp_path)
    asyncio.run(workspace.open_photo(tmp_path / "photo.png"))  # 240 x 180 px
    return workspace


@pytest.fixture
def build(workspace):
    """Builds a part of the page of the workspace, which no browser shows."""
    with Client(page(""), request=None):
        yield lambda part: part(workspace)


def send(stage, kind, x=0.0, y=0.0, **values):
    asyncio.run(
        stage._handle(
            SimpleNamespace(args={"type": kind, "x": x, "y": y, "reach": 4 / 240, **values})
        )
    )


def drag(stage, start, end):
    for kind, (x, y) in (("press", start), ("move", end), ("release", end)):
        send(stage, kind, (x + 0.5) / 240, (y + 0.5) / 180)


def test_gestures_come_as_fractions_and_become_a_box_in_px(workspace, build):
    shot = workspace.session.shot
    stage = build(Stage)
    asyncio.run(stage.refresh())
    drag(stage, (20, 30), (120, 90))
    assert shot.box == pytest.approx((20, 30, 120, 90))
    drag(stage, (122, 60), (150, 60))  # the right edge, which is near enough
    assert shot.box == pytest.approx((20, 30, 150, 90))
    send(stage, "nudge", dx=-1, dy=0, shift=True)
    assert shot.box == pytest.approx((10, 30, 140, 90))
    for box in ((20, 30, 150, 90), (10, 30, 140, 90)):
        send(stage, "undo")  # the second one repeats it
        assert shot.box == pytest.approx(box)
    for kind in ("press", "move", "cancel", "release"):
        send(stage, kind, 0.9, 0.9)
    assert (shot.box, stage.shapes.content.count("<rect")) == (pytest.approx((10, 30, 140, 90)), 2)
    assert "viewBox='-0.5 -0.5 240 180'" in stage.shapes.content
    send(stage, "remove")
    assert shot.box is None
    assert "<rect" not in stage.shapes.content


def test_messages_are_text_and_not_html(workspace, build):
    steps = build(Steps)
    workspace.messages["mesh"] = "a.ply: <b>empty</b>"
    steps.refresh()
    assert steps.messages["mesh"].content == "a.ply: &lt;b&gt;empty&lt;/b&gt;"
    assert "disabled" in steps.find.props


def test_typed_numbers_go_into_the_session(workspace, build):
    inputs = build(Inputs)
    session = workspace.session

    def typed(words):
        inputs.camera.set_value(words)
        asyncio.run(inputs._typed())
        inputs.refresh()
        return session.options.camera, session.options.guess

    for words in ("300 300 119.5", "3e", "300"):
        assert typed(words) == (None, None), "not before it is complete"
    assert typed("300, 300, 119.5 89.123456789") == ((300, 300, 119.5, 89.123456789), None)
    assert typed("65.5") == (None, 65.5)
    assert typed("") == (None, None)
    asyncio.run(inputs._set_camera(guess="exif"))
    inputs.refresh()
    assert inputs.camera_facts.content.endswith("has no focal length")
    session.options = replace(session.options, camera=(300.0, 300.0, 119.5, 0.1 + 0.2), guess=None)
    inputs.refresh()
    assert inputs.camera.value == "300 300 119.5 0.30000000000000004"
    asyncio.run(
        inputs._set_camera(Camera([[300.0, 0, 119.5], [0, 300, 89.5], [0, 0, 1]], (0.1, 0, 0, 0)))
    )
    inputs.refresh()
    assert inputs.camera_facts.content == "from a calibration file, without its distortion"
    assert isinstance(typed(inputs.camera.value)[0], Camera), "what is shown is not typed"
    assert inputs.command.content.startswith("None: ")


def test_clicks_on_the_model_mark_what_is_up_and_the_front_in_all_windows(workspace, build):
    session = workspace.session
    previews = [build(Preview), build(Preview)]
    asyncio.run(workspace.open_mesh(workspace.folder / "truck.ply"))

    def click(mark, *point):
        previews[0].mark = mark
        hit = SimpleNamespace(**dict(zip("xyz", point, strict=True)))
        asyncio.run(previews[0]._clicked(SimpleNamespace(hits=[hit])))
        return session.options.up, session.options.limits.get("front")

    assert click("", 0, 0.9, 0) == (None, "-x")
    assert click("front", 0.1, -0.9, 0.2) == (None, session.mesh_axis((0.0, -1.0, 0.0)))
    session.hint_direction((3.0, 0.0, 0.0))
    for preview in previews:
        asyncio.run(preview.refresh())
        assert (
            preview.facts.content
            == "Pose prior: seen from azimuth 90, elevation 0, within 45 degrees."
        )
    assert "--near 90 0 0 --within 45" in session.command()
    session.remove_limits()
    assert "--near" not in session.command()
    session.set_limits(front=None)
    assert click("up", 0.1, 0.9, 0.2) == ("y", None)
    assert click("up", 0, 0, -1.0) == ("-y", None)
    assert session.mesh.metadata["up"] == "-y"
    assert click("front", 0, 0, 1.0) == ("-y", None), "what is up is not the front"


@pytest.fixture
def shown(session, tmp_path):
    """The page of a session with a result."""
    workspace = Workspace(session.options, tmp_path)
    workspace.session = session
    with Client(page(""), request=None):
        yield workspace


def test_each_remark_has_its_repair(shown, monkeypatch):
    session = shown.session
    started = []
    shot = session.shot
    answers = Answers(shown)
    monkeypatch.setattr(
        shown, "start_search", lambda: started.append((shot.box, session.options.guess))
    )
    plain = {**session.document(), "corrected_box": None}
    before = shot.box
    assert answers._repairs(plain) == {}
    hint = {
        **plain,
        "prior": {"contradiction": "better outside"},
        "corrected_box": [1.04, 2, 30, 40],
    }
    session.set_limits(elevation=(0.0, 10.0))
    repairs = answers._repairs(hint)
    assert list(repairs) == ["Search without the prior", "Search with that box"]
    for repair in repairs.values():
        repair()
    assert session.options.limits == {}
    assert started == [(before, None), ((1.0, 2, 30, 40), None)]


def test_the_pose_is_dragged_on_the_photograph(shown):
    shot = shown.session.shot
    posed = Stage(shown)
    asyncio.run(posed.refresh())
    assert posed.mode == "pose"
    assert "disabled" in posed.undo.props
    T, K = shot.answer.pose.projection
    describer = shot.result.registrar.describer

    def centre():
        T = shot.answer.pose.projection[0]
        at = K @ (T[:3, :3] @ describer.centre + T[:3, 3])
        return (at[:2] / at[2]).tolist()

    x, y = centre()
    drag(posed, (x, y), (x + 20, y + 10))
    assert centre() == pytest.approx([x + 20, y + 10], abs=1e-6)
    assert shot.answer.pose.projection[0][:3, :3].tolist() == T[:3, :3].tolist()
    asyncio.run(posed.refresh())
    assert "disabled" not in posed.undo.props
    drag(posed, (2, 2), (22, 2))  # beside the mesh: it turns
    assert (centre(), len(shot.answer.edits)) == (pytest.approx([x + 20, y + 10], abs=1e-6), 2)
    send(posed, "undo")
    assert len(shot.answer.edits) == 1
    for kind, values in (
        ("scale", {"factor": 1.1, "roll": 5.0}),
        ("nudge", {"dx": 1, "dy": 0, "shift": True}),
    ):
        send(posed, kind, **values)
    assert len(shot.answer.edits) == 1, "one change, when it rests"
    posed._last_gesture -= 10
    asyncio.run(posed.refresh())
    assert len(shot.answer.edits) == 2
    send(posed, "scale", factor=1e6, roll=0.0)  # it would touch the camera
    assert posed.moved is None
    posed._set_mode("box")
    asyncio.run(posed.refresh())
    assert "class='handle line'" in posed.shapes.content


def test_photographs_are_chosen_from_a_strip(shown, registered):
    session = shown.session
    stage = Stage(shown)
    asyncio.run(stage.refresh())
    assert stage.strip.default_slot.children == []
    first = session.shot
    second = session.open_photo(registered[1] / "photo.png")
    asyncio.run(stage.refresh())
    assert (stage.mode, stage.layers.visible) == ("box", False)
    one, other = stage.strip.default_slot.children
    assert (one.props["aria-pressed"], other.props["aria-pressed"]) == ("false", "true")
    assert ("done" in one.classes, "done" in other.classes) == (True, False)
    drag(stage, (20, 30), (120, 90))
    stage._select(first)
    asyncio.run(stage.refresh())
    assert (session.shot, stage.mode, stage.layers.visible) == (first, "pose", True)
    assert second.box == pytest.approx((20, 30, 120, 90))
    T = first.answer.pose.projection[0]
    send(stage, "scale", factor=1.1, roll=5.0)
    session.shot = second  # in another window, and this one has not noticed yet
    drag(stage, (40, 50), (100, 80))
    stage._commit()
    assert second.box == pytest.approx((20, 30, 120, 90))
    assert (second.answer, first.answer.pose.projection[0].equal(T)) == (None, True)
    stage.mode = "box"
    drag(stage, (40, 50), (100, 80))
    assert second.box == pytest.approx((20, 30, 120, 90))
    asyncio.run(shown.remove_photo())
    stage._select(second)
    assert session.shot is first, "the other one is closed"
    asyncio.run(stage.refresh())
    assert stage.strip.default_slot.children == []
