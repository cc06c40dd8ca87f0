import asyncio
import json
import time
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

from nicegui import ui
from nicegui.client import Client
from nicegui.page import page

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import Camera
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.viewer import side
from curvireg_torch.viewer.page import Steps, build_page
from curvireg_torch.viewer.shot import Shot
from curvireg_torch.viewer.side import Answers, CameraPanel, Inputs, Preview, Space
from curvireg_torch.viewer.stage import Stage
from curvireg_torch.viewer.workspace import Workspace
from tests.viewer.test_session import seen


@pytest.fixture
def workspace(scene):
    workspace = Workspace(RegisterOptions(limits={"front": "-x", "theta": (-10.0, 10.0)}), scene)
    asyncio.run(workspace.open_photo(scene / "photo.png"))  # 240 x 180 px
    return workspace


@pytest.fixture
def build(workspace):
    """Builds a part of the page of the workspace, which no browser shows."""
    with Client(page(""), request=None):
        yield lambda part: part(workspace)


def refresh(*parts):
    for part in parts:
        asyncio.run(part.refresh())


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
    refresh(stage)
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
    workspace.errors["mesh"] = "a.ply: <b>empty</b>"
    steps.refresh()
    assert steps.messages["mesh"].content == "a.ply: &lt;b&gt;empty&lt;/b&gt;"
    assert "disabled" in steps.find.props


def test_typed_numbers_go_into_the_session(workspace, build):
    panel = build(CameraPanel)
    inputs = build(Inputs)
    session = workspace.session

    def typed(matrix=None, view=None):
        asyncio.run(panel._set(1, view) if matrix is None else panel._set(4, matrix))
        refresh(panel)
        return session.options.camera

    def shown():
        return [element.props.get("data-value") for element in (panel.matrix, panel.view)]

    assert typed("300, 300, 119.5 89.123456789") == (300, 300, 119.5, 89.123456789)
    assert shown() == ["300 300 119.5 89.123456789", ""]
    for words in ("300 300 119.5", "3e", "300", "nan 1 2 3", "0 300 119.5 89.5"):
        assert typed(words) == (300, 300, 119.5, 89.123456789), "refused"
        assert panel.message.content.startswith("camera"), words
        assert shown()[0] == "300 300 119.5 89.123456789"
    assert typed("536,8 538,2 310,4 241") == (536.8, 538.2, 310.4, 241.0)
    assert panel.message.content == ""
    assert typed(view="190") == (536.8, 538.2, 310.4, 241.0)
    assert "field of view" in panel.message.content
    assert typed(view="65,5") == 65.5
    assert shown() == ["", "65.5"]
    assert typed(view="") is None
    session.set_camera("exif")
    refresh(panel)
    assert panel.facts.content.endswith("has no focal length")
    assert typed("") is None
    session.options = replace(session.options, camera=(300.0, 300.0, 119.5, 0.1 + 0.2))
    refresh(panel)
    assert shown() == ["300 300 119.5 0.30000000000000004", ""], "from another window"
    session.set_camera(Camera([[300.0, 0, 119.5], [0, 300, 89.5], [0, 0, 1]], (0.1, 0, 0, 0)))
    refresh(panel, inputs)
    assert panel.facts.content == "from a calibration file, without its distortion"
    assert inputs.command.content.startswith("None: ")
    session.set_camera()
    session.shot.photo = replace(session.shot.photo, focal_35mm=37.0)
    refresh(panel)
    assert panel.facts.content.endswith("s EXIF, 37 mm of a 35 mm camera"), "unasked"
    session.set_camera("exif")
    session.shot = Shot()
    refresh(panel)
    assert panel.facts.content.endswith("s EXIF"), "of one that is still to come"


def test_what_is_typed_before_the_button_is_pressed_is_what_the_search_uses(
    workspace, build, monkeypatch
):
    """On a slow server too: the search waits until the camera has been set."""
    panel = build(CameraPanel)
    session = workspace.session
    set_camera = session.set_camera
    used = []

    def slow_camera(*camera):
        time.sleep(0.3)
        set_camera(*camera)

    monkeypatch.setattr(session, "set_camera", slow_camera)
    monkeypatch.setattr(session, "register", lambda: used.append(session.options.camera))

    async def type_and_press():
        typed = asyncio.create_task(panel._set(4, "536.8 538.2 310.4 241"))
        await asyncio.sleep(0)  # as two events of a browser come
        await workspace.start_search()
        await typed

    asyncio.run(type_and_press())
    assert used == [(536.8, 538.2, 310.4, 241.0)]


def test_the_page_goes_on_after_an_error_of_one_of_its_parts(workspace, monkeypatch):
    timers = []
    monkeypatch.setattr(ui, "timer", lambda _, refresh: timers.append(refresh))
    with Client(page(""), request=None):
        build_page(workspace)
        drawn = []
        monkeypatch.setattr(Steps, "show_messages", lambda _: drawn.append(True))
        monkeypatch.setattr(
            CameraPanel, "refresh", Mock(side_effect=InvalidInputError("camera: of another size"))
        )
        asyncio.run(timers[0]())
    assert workspace.messages["page"] == "camera: of another size"
    assert drawn


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
        refresh(preview)
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
    assert session.mesh.up == "-y"
    assert click("front", 0, 0, 1.0) == ("-y", None), "what is up is not the front"


def test_a_mesh_that_is_not_drawn_is_said_and_has_no_buttons(workspace, build, monkeypatch):
    monkeypatch.setattr(side, "MAX_VIEWER_FACES", 967)
    preview = build(Preview)
    asyncio.run(workspace.open_mesh(workspace.folder / "truck.ply"))
    refresh(preview)
    assert not any(element.visible for element in preview.of_scene)
    assert preview.no_prior.visible
    workspace.session.remove_limits()
    refresh(preview)
    assert preview.facts.content == "Meshes of more than 967 faces are not drawn."


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
    answers = Answers(shown, Mock())
    monkeypatch.setattr(
        shown, "start_search", lambda: started.append((shot.box, session.options.camera))
    )
    plain = {**session.document(), "corrected_box": None}
    before = shot.box
    camera = session.options.camera
    assert answers._repairs(plain) == {}
    hint = {
        **plain,
        "prior": {"contradiction": "better outside"},
        "corrected_box": [1.04, 2, 30, 40],
    }
    session.set_limits(elevation=(0.0, 10.0))
    repairs = answers._repairs(hint)
    assert list(repairs) == ["Search without the prior", "Search with that box"]
    with monkeypatch.context() as patch:  # a search in another photograph
        patch.setattr(Workspace, "searching", True)
        for repair in repairs.values():
            repair()
    assert (started, shot.box) == ([], before)
    for repair in repairs.values():
        repair()
    assert session.options.limits == {}
    assert started == [(before, camera), ((1.0, 2, 30, 40), camera)]


def test_the_pose_is_dragged_on_the_photograph(shown):
    shot = shown.session.shot
    posed = Stage(shown)
    refresh(posed)
    assert posed.mode == "pose"
    assert "disabled" in posed.undo.props
    T, K = shot.answer.pose.projection
    describer = shot.result.registrar.describer

    def centre():
        return seen(shot.answer.pose.projection[0], K, describer.centre).tolist()

    x, y = centre()
    drag(posed, (x, y), (x + 20, y + 10))
    assert centre() == pytest.approx([x + 20, y + 10], abs=1e-6)
    assert shot.answer.pose.projection[0][:3, :3].tolist() == T[:3, :3].tolist()
    refresh(posed)
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
    refresh(posed)
    assert len(shot.answer.edits) == 2
    send(posed, "scale", factor=1e6, roll=0.0)  # it would touch the camera
    assert posed.moved is None
    posed._set_mode("box")
    refresh(posed)
    assert "class='handle line'" in posed.shapes.content


def test_what_is_saved_and_drawn_is_the_answer_at_the_click(shown, monkeypatch):
    shot = shown.session.shot
    stage = Stage(shown)
    answers = Answers(shown, stage.commit)
    space = Space(shown)
    monkeypatch.setattr(ui.download, "from_url", Mock())
    refresh(stage)
    send(stage, "scale", factor=1.1, roll=5.0)

    async def click():
        async with shown._lock:  # a photograph opens
            saving = asyncio.gather(answers._download("result.json"), space._draw())
            await asyncio.sleep(0)
            clicked = shot.answer
            shown.session.open_photo(shot.path)
            shot.choose(1)
        await saving
        return clicked

    assert space.drawn is None
    clicked = asyncio.run(click())
    assert space.drawn is clicked
    viewer = json.loads(shown.files["result.json"][0])["viewer"]
    assert (viewer["hypothesis"], viewer["by_hand"]) == (0, list(clicked.edits))
    assert len(clicked.edits) == 1, "the wheel was at rest for less than a moment"
    shown.session.shot = shot
    refresh(stage)
    send(stage, "scale", factor=1.1, roll=5.0)
    shot.choose(0)
    stage._last_gesture -= 10
    refresh(stage)
    assert shot.answer.edits == (), "what was moved was another answer"


def test_photographs_are_chosen_from_a_strip(shown, registered):
    session = shown.session
    stage = Stage(shown)
    refresh(stage)
    assert stage.strip.default_slot.children == []
    first = session.shot
    second = session.open_photo(registered[1] / "photo.png")
    refresh(stage)
    assert (stage.mode, stage.layers.visible) == ("box", False)
    one, other = stage.strip.default_slot.children
    assert (one.props["aria-pressed"], other.props["aria-pressed"]) == ("false", "true")
    assert ("done" in one.classes, "done" in other.classes) == (True, False)
    drag(stage, (20, 30), (120, 90))
    stage._select(first)
    refresh(stage)
    assert (session.shot, stage.mode, stage.layers.visible) == (first, "pose", True)
    assert second.box == pytest.approx((20, 30, 120, 90))
    T = first.answer.pose.projection[0]
    send(stage, "scale", factor=1.1, roll=5.0)
    session.shot = second  # in another window, and this one has not noticed yet
    drag(stage, (40, 50), (100, 80))
    stage.commit()
    assert second.box == pytest.approx((20, 30, 120, 90))
    assert (second.answer, first.answer.pose.projection[0].equal(T)) == (None, True)
    stage.mode = "box"
    drag(stage, (40, 50), (100, 80))
    assert second.box == pytest.approx((20, 30, 120, 90))
    asyncio.run(shown.remove_photo())
    stage._select(second)
    assert session.shot is first, "the other one is closed"
    refresh(stage)
    assert stage.strip.default_slot.children == []
