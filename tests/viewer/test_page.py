"""The photograph, the steps and the fields of the page, without a browser."""

import asyncio
from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

from nicegui.client import Client
from nicegui.page import page

from curvireg_torch.evaluation.opening import RegisterOptions
from curvireg_torch.geometry.pose_prior import PosePrior
from curvireg_torch.viewer.page import Steps
from curvireg_torch.viewer.session import Session
from curvireg_torch.viewer.side import Inputs
from curvireg_torch.viewer.stage import Stage, contour_paths
from curvireg_torch.viewer.workspace import Workspace
from tests.viewer.test_session import write_scene


@pytest.fixture
def workspace(tmp_path):
    write_scene(tmp_path)
    options = RegisterOptions(limits={"front": "-x", "theta": (-10.0, 10.0)})
    workspace = Workspace(Session(options), tmp_path / "page", asyncio.Semaphore(1))
    asyncio.run(workspace.open_photo(tmp_path / "photo.png", "photo.png"))  # 240 x 180 px
    return workspace


@pytest.fixture
def build(workspace):
    """Builds a part of the page of the workspace, which no browser shows."""
    with Client(page(""), request=None):
        yield lambda part: part(workspace)


def send(stage, kind, x=0.0, y=0.0, **values):
    asyncio.run(stage._handle(SimpleNamespace(args={"type": kind, "x": x, "y": y, "reach": 4 / 240, **values})))


def drag(stage, start, end):
    for kind, (x, y) in (("press", start), ("move", end), ("release", end)):
        send(stage, kind, (x + 0.5) / 240, (y + 0.5) / 180)


def test_gestures_come_as_fractions_and_become_a_box_in_px(workspace, build):
    session, stage = workspace.session, build(Stage)
    drag(stage, (20, 30), (120, 90))
    assert session.box == pytest.approx((20, 30, 120, 90))
    drag(stage, (122, 60), (150, 60))  # the right edge, which is near enough
    assert session.box == pytest.approx((20, 30, 150, 90))
    send(stage, "nudge", dx=-1, dy=0, shift=True, alt=False)
    assert session.box == pytest.approx((10, 30, 140, 90))
    send(stage, "nudge", dx=0, dy=1, shift=False, alt=True)
    assert session.box == pytest.approx((10, 30, 140, 91))
    send(stage, "undo")
    assert session.box == pytest.approx((10, 30, 140, 90))
    for kind in ("press", "move", "cancel", "release"):
        send(stage, kind, 0.9, 0.9)
    assert session.box == pytest.approx((10, 30, 140, 90))
    assert stage.shapes.content.count("<rect") == 2
    assert "viewBox='-0.5 -0.5 240 180'" in stage.shapes.content
    send(stage, "remove")
    assert session.box is None
    assert "<rect" not in stage.shapes.content


def test_a_click_on_a_dashed_box_chooses_it(workspace, build, monkeypatch):
    monkeypatch.setattr(workspace.session, "proposals", lambda: [[10.04, 20, 60, 70], [100, 20, 160, 70]])
    stage = build(Stage)
    drag(stage, (200, 150), (200, 150))
    assert workspace.session.box is None
    assert stage.shapes.content.count("stroke-dasharray='4 6'") == 4
    drag(stage, (130, 40), (130, 40))
    assert workspace.session.box == (100, 20, 160, 70)


def test_steps_tick_off_and_say_what_is_missing(workspace, build):
    steps = build(Steps)

    def done():
        steps.refresh()
        return [name for name, card in steps.cards.items() if "done" in card.classes]

    assert done() == ["photograph"]
    assert steps.facts["photograph"].content == "photo.png: 240 x 180 px"
    assert "disabled" in steps.find.props
    asyncio.run(workspace.open_mesh(workspace.folder.parent / "truck.ply", "truck.ply"))
    workspace.messages["mesh"] = "a.ply: <b>empty</b>"
    assert done() == ["photograph", "mesh"]
    assert steps.messages["mesh"].content == "a.ply: &lt;b&gt;empty&lt;/b&gt;", "text, not HTML"
    assert "disabled" not in steps.find.props
    assert steps.find.content == "Find the object and its pose"
    workspace.session.box = (10.0, 20.0, 60.0, 70.0)
    assert done() == ["photograph", "mesh", "box"]
    assert steps.find.content == "Find the pose"


def test_typed_numbers_and_sides_go_into_the_session(workspace, build):
    inputs, session = build(Inputs), workspace.session
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
    session.set_limits(azimuth=PosePrior.side("left").azimuth)
    inputs.refresh()
    assert [number.value for number in inputs.known] == [225, 315, None, None]
    inputs.known[1].set_value(300)
    assert " --front=-x --theta -10 10 --azimuth 225 300 " in session.command()
    inputs.known[0].set_value(None)
    assert "--azimuth" not in session.command()


def test_two_windows_do_not_overwrite_each_others_limits(workspace, build):
    one, other = build(Inputs), build(Inputs)
    for number, value in zip(one.known[:2], (300, 60), strict=True):
        number.set_value(value)
    other.refresh()  # as it does several times a second
    for number, value in zip(other.known[2:], (0, 45), strict=True):
        number.set_value(value)
    one.refresh()
    limits = workspace.session.options.limits
    assert (limits["azimuth"], limits["elevation"]) == ((300, 60), (0, 45))
    assert [number.value for number in one.known] == [300, 60, 0, 45]


@pytest.fixture
def posed(registered, tmp_path):
    """A stage that shows the first answer of a session."""
    session = registered[0]
    session.choose(0)
    with Client(page(""), request=None):
        stage = Stage(Workspace(session, tmp_path / "page", asyncio.Semaphore(1)))
        asyncio.run(stage.refresh())
        yield stage


def test_the_pose_is_dragged_on_the_photograph(posed):
    session = posed.session
    assert posed.mode == "pose"
    T, K = session.answer.pose.projection
    describer = session.result.registrar.describer

    def centre():
        at = K @ (session.answer.pose.projection[0] @ torch_point(describer.centre))[:3]
        return (at[:2] / at[2]).tolist()

    x, y = centre()
    drag(posed, (x, y), (x + 20, y + 10))
    assert centre() == pytest.approx([x + 20, y + 10], abs=1e-6)
    assert session.answer.pose.projection[0][:3, :3].tolist() == T[:3, :3].tolist()
    asyncio.run(posed.refresh())
    drag(posed, (2, 2), (22, 2))  # beside the mesh: it turns
    assert centre() == pytest.approx([x + 20, y + 10], abs=1e-6)
    assert len(session.answer.edits) == 2
    send(posed, "undo")
    assert len(session.answer.edits) == 1
    for kind, values in (
        ("scale", {"factor": 1.1, "roll": 5.0}),
        ("nudge", {"dx": 1, "dy": 0, "shift": True, "alt": False}),
    ):
        send(posed, kind, **values)
    assert len(session.answer.edits) == 1, "one change, when it rests"
    posed._last_gesture -= 10
    asyncio.run(posed.refresh())
    assert len(session.answer.edits) == 2
    send(posed, "scale", factor=1e6, roll=0.0)  # it would touch the camera
    assert not posed._commit()
    posed._set_mode("box")
    asyncio.run(posed.refresh())
    assert "class='handle line'" in posed.shapes.content


def torch_point(centre):
    import torch

    return torch.cat([centre, torch.ones(1, dtype=centre.dtype)])


def test_contours_are_followed_at_their_place(registered):
    import re

    import numpy as np

    session = registered[0]
    result, (T, K) = session.result, session.result.registration.projection
    paths = contour_paths(result.registrar, T, K)
    ends = np.array([float(v) for v in re.findall(r"[-\d.]+", paths.split("class='rim'/>")[2].split("class=")[0])])
    ends = ends.reshape(-1, 2)
    depth = result.registrar.describer.renderer.render(T[None], K, (180, 240))[0, 0].numpy() > 0
    rows, columns = np.nonzero(depth)
    assert len(ends) > 200
    box = [columns.min(), rows.min(), columns.max(), rows.max()]
    assert [*ends.min(axis=0), *ends.max(axis=0)] == pytest.approx(box, abs=1.5)
