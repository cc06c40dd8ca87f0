"""A rig file on the page: photographs of one pose. No browser is needed."""

import asyncio
import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from torch.testing import assert_close

from curvireg_torch.cli import main
from curvireg_torch.geometry import Camera, rotation_error
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.jobs.rigs import CAMERA
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.viewer import session as session_module
from curvireg_torch.viewer.workspace import Workspace
from tests._support import double, learned_registrar, refused
from tests._support.calibrations import calibration
from tests._support.lists import (
    RIG_HEADER,
    write_bop_scene,
    write_colmap,
    write_rig_photos,
    written,
)
from tests.registration.test_several import WORLD
from tests.viewer.test_session import document_of, run_program
from tests.viewer.test_workspace import started, upload


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """Photographs, truck.safetensors, and rig.csv without a box of the second; returns the folder
    and the rows."""
    folder = tmp_path_factory.mktemp("rig")
    rows = write_rig_photos(folder)
    rows[1][1:5] = [""] * 4
    written(folder / "rig.csv", RIG_HEADER, *rows)
    learned_registrar().bank.save(folder / "truck.safetensors")
    return folder, rows


def send(workspace, folder, *names):
    async def work():
        for name in names:
            await upload(workspace, folder / name)

    asyncio.run(work())
    return workspace.session


def search(workspace):
    asyncio.run(started(workspace))
    assert workspace.messages == {}


def test_without_the_rig_a_photograph_is_alone_and_read_again_if_distortion_was_removed(
    workspace, rig, monkeypatch
):
    read = Mock(wraps=session_module.read_photo)
    monkeypatch.setattr(session_module, "read_photo", read)
    session = send(workspace, rig[0], "0.png", "1.png", "rig.csv")
    assert read.call_count == 2
    assert session.together() == session.shots
    asyncio.run(workspace.open_rig(None))
    assert ([shot.view for shot in session.shots], len(session.together())) == ([None, None], 1)
    assert not list(workspace.folder.rglob("rig.csv"))
    assert read.call_count == 2
    image = session.shots[0].image
    session.set_camera(Camera(torch.eye(3), (0.1, 0.0, 0.0, 0.0)))
    assert read.call_count == 2
    session.set_camera(None)
    assert read.call_count == 4
    assert torch.equal(session.shots[0].image, image)


@pytest.mark.slow
def test_a_rig_on_the_page_gives_the_files_of_the_command(workspace, rig, tmp_path):
    folder, rows = rig
    session = send(workspace, folder, "0.png", "rig.csv", "2.png", "1.png", "truck.safetensors")
    assert (workspace.messages, session.rig_gaps()) == ({}, "")
    first, third, second = session.shots
    assert (first.box, second.box, third.box) == (tuple(rows[0][1:5]), None, tuple(rows[2][1:5]))
    assert session.command() == "curvireg register --views rig.csv truck.safetensors --out result"
    search(workspace)
    files = ["--views", str(folder / "rig.csv"), str(folder / "truck.safetensors")]
    assert main(["register", *files, "--quiet", "--out", str(tmp_path / "result")]) == 0
    written = json.loads((tmp_path / "result" / "result.json").read_text())
    document = document_of(session)
    assert rotation_error(double(document["rotation"]), WORLD[:3, :3]) < 1.5
    assert [*document] == [*written, "viewer"]
    for row in written["photographs"]:
        row["photo"] = Path(row["photo"]).name
    for key in document.keys() - {"viewer", "inputs", "mesh", "seconds"}:
        assert document[key] == written[key], key
    assert (document["mesh"], document["inputs"]["rig"]) == ("truck.safetensors", "rig.csv")
    for shot, view in zip((first, second, third), document["photographs"], strict=True):
        assert (shot.projection[0][:3, :3].tolist(), shot.found_box.tolist()) == (
            view["rotation"],
            view["box"],
        )
        assert shot.answer is first.answer
    assert first.glb() == (tmp_path / "result" / "pose.glb").read_bytes()
    assert second.overlay() == (tmp_path / "result" / "overlay.png").read_bytes()
    assert run_program(session, folder)["pose"]["rotation"] == document["rotation"]


@pytest.fixture(scope="module")
def found(rig, tmp_path_factory):
    """A workspace with the answer in two photographs of the rig, and a third photograph."""
    folder = rig[0]
    workspace = Workspace(RegisterOptions(refine=False), tmp_path_factory.mktemp("uploads"))
    (folder / "other.png").write_bytes((folder / "1.png").read_bytes())
    session = send(workspace, folder, "rig.csv", "other.png", "0.png", "2.png", "truck.safetensors")
    search(workspace)
    return workspace, session


def test_photographs_of_no_row_and_rows_without_photograph_are_named(found):
    _, session = found
    missing = "not open: 1.png; drop what is missing here, or go on without"
    assert session.rig_gaps() == f"{missing}; not in the rig: other.png; registered alone"
    other, first, last = session.shots
    assert [shot.result is first.result for shot in (other, first, last)] == [False, True, True]
    assert len(session.document()["photographs"]) == 2
    assert session.command() == "", "the command would miss a photograph"


def test_another_answer_and_a_pose_by_hand_are_those_of_all_photographs(found):
    _, session = found
    _, first, last = session.shots
    session.shot = first

    def check():
        document = document_of(session)
        world = double(document["rotation"])
        assert document["rotation"] == first.answer.pose.rotation.tolist()
        for shot, row in zip((first, last), document["photographs"], strict=True):
            assert_close(shot.projection[0][:3, :3], shot.view.T_cam_from_world[:3, :3] @ world)
            assert_close(shot.projection[0][:3, :3], double(row["rotation"]))
            assert (row["edge_support"], row["name"], row["failure"]) == (None, row["name"], None)
        assert document["T_cam_from_model"] is None
        return document

    last.choose(1)
    assert check()["rotation"] == first.result.document["hypotheses"][1]["rotation"]
    before = first.projection[0]
    moved = first.result.moved(before, translation=(0.2, 0, 0))
    first.place(moved)
    assert_close(first.projection[0], moved)
    assert check()["viewer"]["by_hand"] == ["moved: rotated 0.0 degrees, shifted 0.20 radii"]
    assert first.glb()[:4] == b"glTF"
    last.undo()
    assert_close(first.projection[0], before)
    first.choose(0)


@pytest.mark.parametrize("loose", [False, True])
def test_boxes_that_are_drawn_replace_those_of_the_rig(found, loose):
    """Around the object, and around nearly all of the photograph."""
    workspace, session = found
    _, first, last = session.shots
    before = first.box
    session.shot = first
    tight = [before[0] - 3.0, before[1] - 2.0, before[2] + 3.0, before[3] + 2.0]
    drawn = [10.0, 10.0, 230.0, 170.0] if loose else tight
    first.set_box(tuple(drawn))
    last.set_box(None)
    assert session.inputs() != first.result.inputs
    search(workspace)
    rows = session.document()["photographs"]
    assert rows[0]["box"] == drawn
    assert rows[1]["box"] != list(last.box_before)
    first.set_box(before)
    session.set_limits(azimuth=(0.0, 90.0))
    with refused("a pose prior: photographs of a rig take none"):
        session.register()
    session.remove_limits()


def test_a_calibration_that_comes_while_its_rig_goes_is_that_of_the_photographs(
    workspace, rig, tmp_path, monkeypatch
):
    async def removed(_):
        await workspace.open_rig(None)
        return False

    send(workspace, rig[0], "rig.csv")
    monkeypatch.setattr(workspace, "_add_to_mesh", removed)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 240 180 260 260 119.5 89.5\n")
    session = send(workspace, tmp_path, "cameras.txt")
    assert (workspace.messages, isinstance(session.options.camera, Camera)) == ({}, True)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (9, "5", "rig.csv: row 1: 0.png: the camera's pose: expected rigid transforms"),
        (0, "some/1.png", "rig.csv: row 1: some/1.png and row 2: 1.png have the same file name"),
    ],
)
def test_a_bad_rig_is_named_with_its_row(workspace, rig, tmp_path, column, value, message):
    folder, (first, *rows) = rig
    written(tmp_path / "rig.csv", RIG_HEADER, [*first[:column], value, *first[column + 1 :]], *rows)
    session = send(workspace, folder, "0.png")
    send(workspace, tmp_path, "rig.csv")
    assert workspace.messages["rig"].startswith(message)
    assert (session.rig, session.shot.view) == ({}, None)
    send(workspace, folder, "rig.csv")
    assert (workspace.messages, session.shot.view is session.rig["0"]) == ({}, True)


@pytest.mark.slow
def test_a_distorting_camera_of_the_rig_is_waited_for_and_removed_from_its_photographs(
    workspace, rig, tmp_path
):
    folder, rows = rig
    header = RIG_HEADER.replace(",".join(CAMERA), "camera")
    written(tmp_path / "rig.csv", header, *([*row[:5], "cam.json", *row[9:]] for row in rows))
    content = calibration(260.0, 119.5, 89.5, dist=[-0.2, 0, 0, 0, 0])
    (tmp_path / "cam.json").write_text(content)
    session = send(workspace, folder, "0.png")
    send(workspace, tmp_path, "rig.csv")
    assert "cam.json: no such file" in workspace.messages["rig"]
    assert str(workspace.folder) not in workspace.messages["rig"]
    send(workspace, tmp_path, "cam.json")
    assert workspace.messages == {}
    send(workspace, folder, "1.png", "truck.safetensors")
    assert [shot.is_undistorted for shot in session.shots] == [True, True]
    assert session.shots[0].box != tuple(rows[0][1:5])
    send(workspace, folder, "2.png")
    assert session.command() == "curvireg register --views rig.csv truck.safetensors --out result"
    assert session.options.camera is None
    search(workspace)
    assert session.document()["photographs"][0]["camera"]["distortion"] == [-0.2, 0, 0, 0, 0]
    asyncio.run(workspace.open_rig(None))
    assert [shot.is_undistorted for shot in session.shots] == [False, False, False]


def test_colmap_and_bop_come_as_several_files(workspace, rig, tmp_path):
    folder, rows = rig
    for k, row in enumerate(rows):
        shutil.copy(folder / row[0], tmp_path / f"00000{k}.png")
    write_colmap(tmp_path, rows)
    write_bop_scene(tmp_path, rows, [[5]] * 3, [[5, 6, 20, 30]])
    session = send(workspace, folder, "0.png", "1.png")
    send(workspace, tmp_path, "images.txt")
    assert workspace.messages["rig"].startswith("images.txt: ")
    send(workspace, tmp_path, "cameras.txt")
    assert (workspace.messages, len(session.together())) == ({}, 2)
    assert session.rig_gaps() == "not open: 2.png; drop what is missing here, or go on without"
    example_mesh().apply_scale(1000.0).export(tmp_path / "obj_000005.ply")
    names = (
        "scene_camera.json",
        "000000.png",
        "scene_gt.json",
        "scene_gt_info.json",
        "obj_000005.ply",
    )
    send(workspace, tmp_path, *names)
    assert (workspace.messages, session.options.unit) == ({}, "mm")
    assert not session.options.unit_is_given
    assert [shot.path.name for shot in session.together()] == ["000000.png"]
    assert session.shot.box == (5.0, 6.0, 25.0, 36.0)
    send(workspace, tmp_path, "000001.png", "000002.png")
    assert (
        session.command() == "curvireg register --views SCENE obj_000005.ply --unit mm --out result"
    )
    session.shot.set_box((6.0, 6.0, 25.0, 36.0))
    assert session.command() == ""


def test_the_second_photograph_of_a_name_gets_the_row_once_the_first_is_removed(workspace, rig):
    """Names count without folders and suffixes."""
    folder = rig[0]
    shutil.copy(folder / "0.png", folder / "0.jpg")
    session = send(workspace, folder, "rig.csv", "0.png", "1.png", "0.jpg")
    first, other, second = session.shots
    assert first.view is session.rig["0"]
    assert (second.view, session.shot) == (None, second)
    session.shot = first
    asyncio.run(workspace.remove_photo())
    assert session.shots[0] is session.shot is other, "with its result"
    assert [shot.view for shot in session.together()] == [first.view, other.view]
