"""What strangers upload names uploaded files only: the page neither reads other files nor tells
which exist."""

import json
import os

import pytest

from tests._support.calibrations import calibration
from tests._support.lists import (
    RIG_HEADER,
    write_bop_scene,
    write_colmap,
    write_rig_photos,
    written,
)
from tests.viewer.test_rig import send

IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1]
CALIBRATION = calibration(260.0, 119.5, 89.5)


@pytest.fixture
def outside(tmp_path):
    """A folder of the server: ``secret`` is no calibration, ``cam.json`` is one, ``0.png`` a
    photograph."""
    folder = tmp_path / "server"
    folder.mkdir()
    (folder / "secret").write_text("TOKEN-hunter2\nuser:root\n")
    (folder / "cam.json").write_text(CALIBRATION)
    (folder / "images").mkdir()
    return folder


def rig_with_camera(folder, camera, name="rig.csv"):
    pose = [*IDENTITY, 0, 0, 1]
    header = RIG_HEADER.replace("fx,fy,cx,cy", "camera")
    written(folder / name, header, ["0.png", "", "", "", "", camera, *pose])
    return name


def spellings(workspace, path):
    """A foreign file as an uploaded one may name it."""
    up = os.path.relpath(path, workspace.folder / "upload-x")
    return str(path), up, up.replace("/", "\\"), f"{path}:cam0", f"x/../{up}"


def test_a_rig_on_the_page_reads_no_file_of_the_server(workspace, outside, tmp_path):
    for name in ("secret", "cam.json"):
        for present in (outside / name, outside / "absent" / name):
            said = set()
            for camera in spellings(workspace, present):
                session = send(workspace, tmp_path, rig_with_camera(tmp_path, camera))
                message = workspace.messages["rig"]
                assert "hunter2" not in message
                assert str(tmp_path) not in message
                assert session.rig == {}
                said.add(message.replace(":cam0", ""))
            assert said == {f"rig.csv: row 1: 0.png: {name}: no such file; drop it here"}


def test_a_calibration_of_the_uploads_is_found_whatever_folder_the_rig_says(workspace, tmp_path):
    (tmp_path / "cam.json").write_text(f'{{"left": {CALIBRATION}, "right": {CALIBRATION}}}')
    for camera in ("cam.json:left", "calibrations/cam.json:left", "C:\\my files\\cam.json:right"):
        session = send(workspace, tmp_path, rig_with_camera(tmp_path, camera), "cam.json")
        assert workspace.messages == {}
        assert next(iter(session.rig.values())).camera.matrix[0, 2] == 119.5


def test_photographs_of_a_rig_are_uploads_too(workspace, outside, tmp_path):
    rows = write_rig_photos(tmp_path)
    up = os.path.relpath(outside, workspace.folder / "upload-x")
    for row, name in zip(rows, ("0.png", "1.png", "2.png"), strict=True):
        (tmp_path / name).rename(outside / name)
        row[0] = f"{up}/{name}"
    write_colmap(tmp_path, rows)
    write_bop_scene(tmp_path, rows, [[5]] * 3, [[5, 6, 20, 30]])
    scene = json.loads((tmp_path / "scene_camera.json").read_text())
    (tmp_path / "scene_camera.json").write_text(
        json.dumps({f"../{up}/{k}": camera for k, camera in scene.items()})
    )
    written(tmp_path / "rig.csv", RIG_HEADER, *rows)
    for names in (("images.txt", "cameras.txt"), ("scene_camera.json",), ("rig.csv",)):
        session = send(workspace, tmp_path, *names)
        assert workspace.messages == {}
        assert len(session.rig) == 3
        for view in session.rig.values():
            assert workspace.folder in view.photo.parents
            assert ".." not in view.photo.parts
