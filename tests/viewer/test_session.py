"""The viewer's session: the result of the command line, moved by hand and fitted again. No page is needed."""

import json
import math
import shlex
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch.cli import main, parse
from curvireg_torch.cli.options import register_options
from curvireg_torch.errors import BankError, CurviregError, CurviregWarning, ImageError, InvalidInputError, MeshError
from curvireg_torch.geometry import rotation_error
from curvireg_torch.pipeline import PRESETS, BankSettings, ViewPolicy
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.viewer.session import Session
from tests._support.exif import exif, with_exif
from tests._support.scenes import scene

VIEWS = ViewPolicy(pose="upright", azimuth_step=30.0, elevations=(10.0, 40.0))


def write_scene(folder: Path, seed: int = 0) -> tuple[list[float], torch.Tensor]:
    """Write photo.png, truck.ply and small.json; returns the box and the true pose."""
    image, box, T = scene(seed)
    picture = (image.permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype(np.uint8)
    cv2.imwrite(str(folder / "photo.png"), picture)
    example_mesh().export(folder / "truck.ply")
    small = replace(PRESETS["classical"], views=VIEWS, bank=BankSettings(image_size=96), hypotheses=2)
    (folder / "small.json").write_text(small.to_json())
    return [float(v) for v in box], T


def run_command(folder: Path, command: str) -> dict:
    """Run a command line of the viewer; returns its result."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("CURVIREG_CACHE", str(folder / "cache"))
        assert main([*shlex.split(command)[1:], "--quiet"]) == 0
    return json.loads((folder / "result" / "result.json").read_text())


def new_session(*words):
    arguments = parse(["view", *words])
    return Session(register_options(arguments, *([path] if path else [] for path in (arguments.photo, arguments.mesh))))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The present folder, with a scene."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CURVIREG_CACHE", str(tmp_path / "cache"))
    write_scene(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def registered(tmp_path_factory):
    """A session with a result, its folder and the true pose."""
    folder = tmp_path_factory.mktemp("viewer")
    box, T = write_scene(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CURVIREG_CACHE", str(folder / "cache"))
        session = new_session("--pipeline", str(folder / "small.json"))
        session.open_photo(folder / "photo.png", "my photo.png")
        session.open_mesh(folder / "truck.ply")
        session.box, session.camera = tuple(round(v, 1) for v in box), (260.0, 260.0, 119.5, 89.5)
        session.register()
        yield session, folder, T


@pytest.fixture
def session(registered):
    """The session at its first hypothesis; its camera is restored afterwards."""
    session = registered[0]
    session.display(0)
    camera = session.camera
    yield session
    session.camera, session.fov = camera, None


def test_command_gives_the_same_result_bit_by_bit(session, registered):
    _, folder, truth = registered
    assert session.command().startswith(f"curvireg register 'my photo.png' {folder / 'truck.ply'} ")
    (folder / "my photo.png").write_bytes((folder / "photo.png").read_bytes())
    written = run_command(folder, session.command())
    document = json.loads(session.json())
    for key in ("rotation", "translation", "score", "confidence", "covariance", "top", "pipeline"):
        assert document[key] == written[key], key
    assert document["inputs"]["box"] == written["inputs"]["box"]
    assert document["viewer"]["command"] == session.command()
    assert all(document["viewer"][key] == written[key] for key in ("rotation", "translation", "viewpoint"))
    assert float(rotation_error(torch.tensor(document["rotation"]).double(), truth[:3, :3])) < 10


def test_move_rotates_about_the_centre_and_fit_restores_the_pose(session):
    before = session.displayed.pose
    describer = session.result.registrar.describer
    centre = before.rotation @ describer.centre + before.translation
    session.move(rotation=(0, 6, 0))
    rotated = session.displayed.pose
    assert float(rotation_error(rotated.rotation, before.rotation)) == pytest.approx(6, abs=1e-4)
    torch.testing.assert_close(rotated.rotation @ describer.centre + rotated.translation, centre)
    # Right-handed about the camera's y, which points down: the point nearest to the camera moves to the left.
    front = before.rotation.T @ torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    assert float((rotated.rotation @ front)[0]) < 0
    session.move(translation=(0.05, 0, 0))
    moved = session.displayed.pose.rotation @ describer.centre + session.displayed.pose.translation - centre
    torch.testing.assert_close(moved, torch.tensor([0.05 * describer.radius, 0, 0], dtype=torch.float64))
    assert np.isnan(session.displayed.pose.score)
    assert session.fit().startswith("contours fitted: ")
    assert float(rotation_error(session.displayed.pose.rotation, before.rotation)) < 1.5
    assert float((session.displayed.pose.translation - before.translation).norm()) < 0.03 * float(centre.norm())
    assert [edit.split()[0] for edit in session.displayed.edits] == ["rotated", "moved", "contours"]
    document = session.document()
    assert document["viewer"]["rotation"] == session.displayed.pose.rotation.tolist()
    assert document["rotation"] == before.rotation.tolist()
    session.display(1)
    assert session.document()["viewer"]["hypothesis"] == 1
    assert session.displayed.edits == ()
    with pytest.raises(InvalidInputError, match="touch the camera"):
        session.move(translation=(0, 0, -100))


def test_move_without_a_camera_keeps_the_allocentric_rotation(session):
    session.camera = None
    session.register()
    before = session.displayed.pose
    session.move(rotation=(0, 0, 5))
    pose = session.displayed.pose
    assert pose.translation is None
    assert float(rotation_error(pose.rotation, before.rotation)) == pytest.approx(5, abs=1e-3)
    # A translation keeps the rotation of the projection and changes the allocentric one.
    T = pose.projection[0]
    session.move(translation=(0.1, 0, 0))
    assert torch.equal(session.displayed.pose.projection[0][:3, :3], T[:3, :3])
    assert 0.1 < float(rotation_error(session.displayed.pose.rotation, pose.rotation)) < 5
    assert session.document()["viewer"]["translation"] is None


def test_register_with_a_field_of_view(session):
    camera, session.camera = session.camera, None
    session.fov = 2 * math.degrees(math.atan(120 / 260))
    session.register()
    document = session.document()
    assert document["inputs"]["camera_source"] == "fov"
    assert document["inputs"]["camera"] == pytest.approx(camera)
    assert document["translation"] is not None
    assert document["covariance"] is None


def test_messages_use_the_names_of_the_user(folder):
    session = new_session()
    (folder / "upload-1").write_text("not a picture")
    with pytest.raises(ImageError, match=r"^cat\.jpg: "):
        session.open_photo(folder / "upload-1", "cat.jpg")
    for suffix, error in ((".obj", MeshError), (".safetensors", BankError)):
        (folder / f"upload-2{suffix}").write_text("")
        with pytest.raises(error, match=rf"^cat{suffix}: ") as caught:
            session.open_mesh(folder / f"upload-2{suffix}", f"cat{suffix}")
        assert str(folder) not in str(caught.value)
    assert session.photo_path is session.mesh_path is None
    warnings = CurviregWarning("large", subject=folder / "upload-2.obj"), UserWarning("plain")
    assert list(map(session.describe_warning, warnings)) == ["cat.obj: large", "plain"]
    with pytest.raises(InvalidInputError, match="choose a photograph and a mesh"):
        session.register()
    with pytest.raises(InvalidInputError, match="register first"):
        session.move(rotation=(1, 0, 0))


def test_open_mesh_describes_the_mesh(folder):
    mesh = example_mesh()
    mesh.export(folder / "grey.ply")
    mesh.visual.face_colors = [200, 20, 20, 255]
    mesh.export(folder / "red.ply")
    assert new_session().open_mesh(folder / "grey.ply").endswith(" m, rendered in grey")
    assert new_session().open_mesh(folder / "red.ply").endswith(" m, rendered in its colours")


def test_open_photo_keeps_the_old_one_after_an_error(folder):
    session = new_session()
    session.open_photo(folder / "photo.png")
    (folder / "broken.png").write_bytes((folder / "photo.png").read_bytes()[:200])
    with pytest.raises(ImageError):
        session.open_photo(folder / "broken.png")
    assert session.photo_path == folder / "photo.png"


@pytest.mark.usefixtures("folder")
def test_load_takes_files_box_and_camera_from_the_options():
    session = new_session("photo.png", "truck.ply", "--box", "10", "20", "90", "80", "--fov", "65")
    assert "968 faces" in session.load()
    assert session.command() == "curvireg register photo.png truck.ply --box 10 20 90 80 --fov 65 --out result"


def test_command_contains_inputs_and_options(folder):
    session = new_session("--unit", "mm", "--up=-y", "--pose", "any", "--preset", "fast")
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
    assert "--camera 300 300.5 119.5 89.5 --unit" in session.command(), "a camera takes precedence"
    session.camera = None
    assert "--box 10 20.5 90 80 --fov 65 --unit" in session.command()
    session.fov, session.options = 180.0, replace(session.options, unit="m")
    session.open_mesh(folder / "truck.ply")
    with pytest.raises(InvalidInputError, match="180"):
        session.register()


def test_command_contains_the_limits_on_the_pose(folder):
    words = ["--near", "10", "-20.5", "--within", "30", "--front=-x", "--distance", "0.5", "2"]
    session = new_session("photo.png", "truck.ply", *words)
    session.load()
    session.set_limits(azimuth=(315.0, 45.0), elevation=(-10.0, 40.0))
    again = register_options(parse(shlex.split(session.command())[1:]))
    assert again.limits == session.request().limits
    assert session.request().entry(folder / "photo.png").prior.to_dict() == {
        "azimuth": (315.0, 45.0),
        "elevation": (-10.0, 40.0),
        "distance": (0.5, 2.0),
        "viewpoint": (10.0, -20.5, 0.0),
        "within": 30.0,
        "front": "-x",
    }
    session.set_limits(**{**dict.fromkeys(session.options.limits), "front": "y"})
    assert "--front" not in session.command(), "it limits nothing by itself"


def test_limits_do_not_open_the_mesh_again(session):
    registrar = session.result.registrar
    session.set_limits(elevation=(35.0, 90.0))
    session.register()
    session.set_limits(elevation=None)
    assert session.result.registrar is registrar
    assert session.document()["prior"]["elevation"] == (35.0, 90.0)
    assert session.displayed.pose.viewpoint[1] > 32.0


@pytest.mark.usefixtures("folder")
def test_register_is_cancelled_by_the_limit_and_by_the_user(monkeypatch):
    box = map(str, scene(0)[1].tolist())
    session = new_session("photo.png", "truck.ply", "--pipeline", "small.json", "--box", *box)
    session.load()
    session.limit = 0.0
    with pytest.raises(CurviregError, match=r"stopped after 0 s in the stage .bank."):
        session.register()
    assert session.result is None
    session.limit = 600.0
    callback = session._progress_callback

    def cancel_first(start):
        def report_progress(*progress):
            session.cancel()
            callback(start)(*progress)

        return report_progress

    monkeypatch.setattr(session, "_progress_callback", cancel_first)
    with pytest.raises(CurviregError, match=r"^stopped$"):
        session.register()


def test_a_picked_hypothesis_is_recorded_as_the_users_choice(session):
    session.display(1, chosen=True)
    assert session.document()["viewer"]["chosen"]
    session.display(0)
    assert not session.document()["viewer"]["chosen"]
