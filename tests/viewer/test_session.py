"""What the page computes, without a page: the command line's answer, then moved by hand and pulled in again."""

import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import curvireg_torch
from curvireg_torch.cli import main, parse
from curvireg_torch.cli.options import register_options
from curvireg_torch.errors import CurviregError, ImageError, InvalidInputError, MeshError
from curvireg_torch.geometry import rotation_error
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.settings import BankSettings, ViewPolicy
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.viewer.session import Session
from tests._support.exif import exif, with_exif
from tests._support.scenes import scene

VIEWS = ViewPolicy(pose="upright", azimuth_step=30.0, elevations=(10.0, 40.0))


def write_scene(folder: Path, seed: int = 0) -> tuple[list[float], torch.Tensor]:
    """photo.png, truck.ply and small.json; the photograph's box and the truth."""
    image, box, T = scene(seed)
    picture = (image.permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype(np.uint8)
    cv2.imwrite(str(folder / "photo.png"), picture)
    example_mesh().export(folder / "truck.ply")
    small = replace(PRESETS["classical"], views=VIEWS, bank=BankSettings(image_size=96), hypotheses=2)
    (folder / "small.json").write_text(small.to_json())
    return [float(v) for v in box], T


def options(*words):
    return register_options(parse(["view", *words]))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    return tmp_path


@pytest.fixture(scope="module")
def answered(tmp_path_factory):
    """A session with an answer, its folder and the truth."""
    folder = tmp_path_factory.mktemp("viewer")
    box, T = write_scene(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CURVIREG_CACHE", str(folder / "cache"))
        session = Session(options("--pipeline", str(folder / "small.json")))
        session.open_photo(folder / "photo.png", "my photo.png")
        session.open_mesh(folder / "truck.ply")
        session.box, session.camera = tuple(round(v, 1) for v in box), (260.0, 260.0, 119.5, 89.5)
        session.register()
        yield session, folder, T


def test_the_command_gives_the_same_answer_to_the_digit(answered):
    session, folder, truth = answered
    session.display(0)
    words = shlex.split(session.command())
    assert words[:4] == ["curvireg", "register", "my photo.png", str(folder / "truck.ply")]
    (folder / "my photo.png").write_bytes((folder / "photo.png").read_bytes())
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*words[1:], "--quiet"]) == 0
    written = json.loads((folder / "result" / "result.json").read_text())
    ours = json.loads(session.json())
    for key in ("rotation", "translation", "score", "confidence", "covariance", "top", "pipeline"):
        assert ours[key] == written[key], key
    assert ours["inputs"]["box"] == written["inputs"]["box"]
    assert ours["viewer"]["command"] == session.command()
    assert {key: ours["viewer"][key] for key in ("rotation", "translation", "viewpoint")} == {
        key: written[key] for key in ("rotation", "translation", "viewpoint")
    }
    assert float(rotation_error(torch.tensor(ours["rotation"]).double(), truth[:3, :3])) < 10


def test_the_document_is_of_the_schema(answered):
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    schema = json.loads((Path(curvireg_torch.__file__).parent / "registration" / "result.schema.json").read_text())
    jsonschema.validate(json.loads(answered[0].json()), schema)


def test_a_nudge_turns_about_the_centre_and_the_contours_bring_it_back(answered):
    session, _, _ = answered
    session.display(0)
    before = session.displayed.pose
    describe = session.result.registrar.describers[0]
    centre = before.rotation @ describe.centre + before.translation
    session.move(rotation=(0, 6, 0))
    turned = session.displayed.pose
    assert float(rotation_error(turned.rotation, before.rotation)) == pytest.approx(6, abs=1e-4)
    torch.testing.assert_close(turned.rotation @ describe.centre + turned.translation, centre)
    # Right-handed about the camera's y, which points down: what was before the centre goes to the right.
    front = before.rotation.T @ torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    assert float((turned.rotation @ front)[0]) < 0
    session.move(translation=(0.05, 0, 0))
    moved = session.displayed.pose.rotation @ describe.centre + session.displayed.pose.translation - centre
    torch.testing.assert_close(moved, torch.tensor([0.05 * describe.radius, 0, 0], dtype=torch.float64))
    assert np.isnan(session.displayed.pose.score)
    told = session.fit()
    assert told.startswith("contours fitted: ")
    assert float(rotation_error(session.displayed.pose.rotation, before.rotation)) < 1.5
    assert float((session.displayed.pose.translation - before.translation).norm()) < 0.03 * float(centre.norm())
    assert [word.split()[0] for word in session.displayed.edits] == ["rotated", "moved", "contours"]
    document = session.document()
    assert document["viewer"]["rotation"] == session.displayed.pose.rotation.tolist()
    assert document["rotation"] == before.rotation.tolist()
    session.display(1)
    assert session.document()["viewer"]["hypothesis"] == 1
    assert session.displayed.edits == ()
    with pytest.raises(InvalidInputError, match="touch the camera"):
        session.move(translation=(0, 0, -100))


def test_without_a_camera_the_rotation_is_that_of_the_view(answered):
    session, _, _ = answered
    camera, session.camera = session.camera, None
    try:
        session.register()
        before = session.displayed.pose
        session.move(rotation=(0, 0, 5))
        pose = session.displayed.pose
        assert pose.translation is None
        assert float(rotation_error(pose.rotation, before.rotation)) == pytest.approx(5, abs=1e-3)
        # A shift moves the object in the picture, not its rotation as a camera sees it that looks straight at it.
        T = pose.projection[0]
        session.move(translation=(0.1, 0, 0))
        assert torch.equal(session.displayed.pose.projection[0][:3, :3], T[:3, :3])
        assert 0.1 < float(rotation_error(session.displayed.pose.rotation, pose.rotation)) < 5
        assert session.document()["viewer"]["translation"] is None
    finally:
        session.camera = camera


def test_a_field_of_view_is_the_camera_that_it_says(answered):
    session, _, _ = answered
    session.display(0)
    camera, session.camera = session.camera, None
    session.fov = 2 * math.degrees(math.atan(120 / 260))
    try:
        session.register()
        document = session.document()
        assert document["inputs"]["camera_source"] == "fov"
        assert document["inputs"]["camera"] == pytest.approx(camera)
        assert document["translation"] is not None
        assert document["covariance"] is None
    finally:
        session.camera, session.fov = camera, None


def test_files_are_called_what_the_user_calls_them(folder):
    session = Session(options())
    (folder / "upload-1").write_text("not a picture")
    with pytest.raises(ImageError, match=r"^cat\.jpg: "):
        session.open_photo(folder / "upload-1", "cat.jpg")
    (folder / "upload-2.obj").write_text("")
    with pytest.raises(MeshError, match=r"^cat\.obj: ") as found:
        session.open_mesh(folder / "upload-2.obj", "cat.obj")
    assert str(folder) not in str(found.value)
    assert session.photo_path is None
    assert session.mesh_path is None
    with pytest.raises(InvalidInputError, match="choose a photograph and a mesh"):
        session.register()
    with pytest.raises(InvalidInputError, match="register first"):
        session.move(rotation=(1, 0, 0))


def test_it_says_whether_a_mesh_is_seen_in_its_colours(folder):
    mesh = example_mesh()
    mesh.export(folder / "grey.ply")
    mesh.visual.face_colors = [200, 20, 20, 255]
    mesh.export(folder / "red.ply")
    session = Session(options())
    assert session.open_mesh(folder / "grey.ply").endswith(" m, rendered in grey")
    assert session.open_mesh(folder / "red.ply").endswith(" m, rendered in its colours")


def test_a_broken_file_leaves_the_photograph_that_was_there(folder):
    write_scene(folder)
    session = Session(options())
    session.open_photo(folder / "photo.png")
    (folder / "broken.png").write_bytes((folder / "photo.png").read_bytes()[:200])
    with pytest.raises(ImageError):
        session.open_photo(folder / "broken.png")
    assert session.photo_path == folder / "photo.png"


def test_the_exif_guess_and_the_command(folder):
    write_scene(folder)
    session = Session(options("--unit", "mm", "--up=-y", "--pose", "any", "--preset", "fast"))
    session.open_photo(folder / "photo.png", "photo.png")
    assert session.exif_camera() is None
    with_exif(folder / "photo.png", exif(1, 50))
    session.open_photo(folder / "photo.png", "photo.png")
    focal = 50 * np.hypot(180, 240) / np.hypot(36, 24)
    assert session.exif_camera() == pytest.approx((focal, focal, 119.5, 89.5), abs=0.005)
    session.camera, session.box = session.exif_camera(), (10.0, 20.5, 90.0, 80.0)
    assert session.command() == (
        "curvireg register photo.png MESH --box 10 20.5 90 80 --camera exif "
        "--unit mm --up=-y --pose any --preset fast --out result"
    )
    session.camera = (300.0, 300.5, 119.5, 89.5)
    session.fov = 65.0
    assert "--camera 300 300.5 119.5 89.5 --unit" in session.command(), "a camera goes before the field of view"
    session.camera = None
    assert "--box 10 20.5 90 80 --fov 65 --unit" in session.command()
    session.fov, session.options = 180.0, replace(session.options, unit="m")
    session.open_mesh(folder / "truck.ply")
    with pytest.raises(InvalidInputError, match="180"):
        session.register()


def test_it_is_stopped_and_has_a_limit(folder):
    box, _ = write_scene(folder)
    session = Session(options("--pipeline", "small.json"))
    session.open_photo(folder / "photo.png")
    session.open_mesh(folder / "truck.ply")
    session.box, session.limit = tuple(box), 0.0
    with pytest.raises(CurviregError, match=r"stopped after 0 s in the stage .bank."):
        session.register()
    assert session.result is None
    session.limit, told = 600.0, session._progress_callback

    def stopping(start):
        def report_progress(*told_of):
            session.cancel()
            told(start)(*told_of)

        return report_progress

    session._progress_callback = stopping
    with pytest.raises(CurviregError, match=r"^stopped$"):
        session.register()
