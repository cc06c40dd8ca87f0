"""The viewer's session: the result of the command line, moved by hand and fitted again. No page is
needed."""

import io
import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch.testing import assert_close

from curvireg_torch.cli import main, parse
from curvireg_torch.cli.options import register_options
from curvireg_torch.data.poses import read_pose
from curvireg_torch.errors import CurviregError, CurviregWarning
from curvireg_torch.geometry import Camera, rotation_error, rotation_from_viewpoint, undistorted
from curvireg_torch.jobs.options import WITHIN, RegisterOptions
from curvireg_torch.jobs.store import to_json
from curvireg_torch.pipeline import PRESETS, BankSettings, ViewPolicy
from curvireg_torch.registration import fit_contours
from curvireg_torch.synthetic import example_mesh
from curvireg_torch.viewer import programs
from curvireg_torch.viewer import session as module
from curvireg_torch.viewer import shot as shot_module
from curvireg_torch.viewer.session import Session
from curvireg_torch.viewer.shot import dragged_box
from tests._support import double, refused, scene, slow_after, write_photo
from tests._support.exif import exif, with_exif
from tests._support.tables import text_table

UNCERTAIN = Camera(
    [[260.0, 0.0, 119.5], [0.0, 260.0, 89.5], [0.0, 0.0, 1.0]],
    focal_deviation=0.1,
    source="estimated",
)
VIEWS = ViewPolicy(pose="upright", azimuth_step=30.0, elevations=(10.0, 40.0))


def write_scene(folder, seed=0):
    """Write photo.png, truck.ply and small.json; returns the box and the true pose."""
    image, box, T = scene(seed)
    write_photo(folder / "photo.png", image)
    example_mesh().export(folder / "truck.ply")
    small = replace(
        PRESETS["classical"], views=VIEWS, bank=BankSettings(image_size=96), hypotheses=2
    )
    (folder / "small.json").write_text(small.to_json())
    return [float(v) for v in box], T


def run_command(folder, command):
    """Run a command line of the viewer; returns its result."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("CURVIREG_CACHE", str(folder / "cache"))
        assert main([*shlex.split(command)[1:], "--quiet"]) == 0
    return json.loads((folder / "result" / "result.json").read_text())


def run_program(session, folder):
    """Run the session's Python program in a folder; returns what it names."""
    names = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("CURVIREG_CACHE", str(folder / "cache"))
        exec(session.python(), names)
    return names


def new_session(*words):
    arguments = parse(["view", *words])
    files = ([path] if path else [] for path in (arguments.photo, arguments.mesh))
    return Session(register_options(arguments, *files), Path("uploads"))


def document_of(session):
    """As it is read again."""
    return json.loads(to_json(session.document()))


@pytest.fixture
def folder(scene, monkeypatch):
    """The present folder, with a scene."""
    monkeypatch.chdir(scene)
    monkeypatch.setenv("CURVIREG_CACHE", str(scene / "cache"))
    return scene


def test_command_gives_the_same_result_bit_by_bit(session, registered):
    _, folder, truth = registered
    assert session.command().startswith(
        f"curvireg register '{folder}/my photo.png' {folder / 'truck.ply'} "
    )
    written = run_command(folder, session.command())
    document = document_of(session)
    keys = ("rotation", "translation", "score", "confidence", "covariance", "hypotheses")
    for key in (*keys, "pipeline"):
        assert document[key] == written[key], key
    assert document["inputs"]["box"] == written["inputs"]["box"]
    assert document["viewer"] == {"command": session.command(), "hypothesis": 0, "by_hand": []}
    assert rotation_error(double(document["rotation"]), truth[:3, :3]) < 10


@pytest.mark.slow
def test_without_a_box_the_answer_is_a_detection(session, registered):
    session.shot.set_box(None)
    assert "--box" not in session.command()
    session.register()
    for number in (1, 0):
        session.shot.choose(number)
        document = document_of(session)
        assert document["detection"]["instances"][0]["rotation"] == document["rotation"]
    assert document["rotation"] != document["hypotheses"][1]["rotation"]
    assert document["rotation"] == run_command(registered[1], session.command())["rotation"]


def test_the_chosen_answer_is_the_result_with_its_own_verdict(session, registered):
    shot = session.shot
    found = shot.result.registration
    first = session.document()
    shot.choose(1)
    document = document_of(session)
    best, second = first["hypotheses"]
    for name in ("rotation", "translation", "score"):
        assert document[name] == second[name]
    rotations = [one["rotation"] for one in document["hypotheses"]]
    assert rotations == [second["rotation"], best["rotation"]]
    assert document["viewer"]["hypothesis"] == 1
    # A pipeline that was calibrated has probabilities; each answer has its own.
    calibrated = replace(found, probabilities=(0.95, 0.03))
    shot.result = replace(shot.result, registration=calibrated)
    document = session.document()
    assert (document["confidence"], document["reliable"]) == (0.03, False)
    assert document["probabilities"] == [0.03, 0.95]
    assert document["no_match_probability"] == pytest.approx(0.02)
    assert document["covariance"] is None
    shot.choose(0)
    assert shot.result.chosen is calibrated
    shot.result = replace(shot.result, registration=found)
    # The file is a start for the command line, and picture and scene show the same pose.
    folder = registered[1]
    shot.choose(1)
    (folder / "chosen.json").write_text(to_json(session.document()))
    start = read_pose(folder / "chosen.json")
    assert start.T.tolist() == shot.answer.pose.transform.double().tolist()
    assert start.confidence is None
    scene = trimesh.load(io.BytesIO(shot.glb()), file_type="glb")
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    assert np.allclose(flip @ scene.graph["object"][0], shot.answer.pose.transform, atol=1e-5)
    overlays = [shot.overlay()]
    shot.choose(0)
    assert shot.overlay() != overlays[0]


def test_a_pose_set_by_hand_is_the_result_without_a_probability(session):
    shot = session.shot
    before = shot.answer.pose
    describer = shot.result.registrar.describer
    centre = before.rotation @ describer.centre + before.translation
    assert shot.result.answer_before is None
    moved = shot.result.moved(before.projection[0], rotation=(0, 6, 0), translation=(0.05, 0, 0))
    shot.place(moved)
    pose = shot.answer.pose
    assert rotation_error(pose.rotation, before.rotation) == pytest.approx(6, abs=1e-4)
    shift = pose.rotation @ describer.centre + pose.translation - centre
    assert_close(shift, double([0.05 * describer.radius, 0, 0]))
    document = document_of(session)
    assert document["rotation"] == pose.rotation.tolist() == document["hypotheses"][0]["rotation"]
    assert len(document["hypotheses"]) == 2
    unknown = ("confidence", "no_match_probability", "score", "edge_support")
    for name in (*unknown, "covariance", "ambiguous"):
        assert document[name] is None, name
    assert not document["reliable"]
    assert (document["probabilities"], document["confidence_features"]) == ([], {})
    assert document["viewer"]["by_hand"] == ["moved: rotated 6.0 degrees, shifted 0.05 radii"]
    shot.fit()
    fitted = shot.answer
    assert fitted.edits[1].startswith("contours fitted, edge support ")
    assert rotation_error(fitted.pose.rotation, before.rotation) < 1.5
    assert (fitted.pose.translation - before.translation).norm() < 0.03 * float(centre.norm())
    for answer in (pose, fitted.pose):  # one step back, and again
        shot.undo()
        assert shot.answer.pose is answer
    shot.choose(1)
    assert (shot.answer.edits, shot.result.answer_before) == ((), None)
    with refused("touch the camera"):
        shot.result.moved(moved, translation=(0, 0, -100))


def test_a_fit_belongs_to_the_answer_that_it_began_from(session, monkeypatch):
    shot = session.shot

    def fit(*given, **how):
        shot.choose(1)
        return fit_contours(*given, **how)

    monkeypatch.setattr(shot_module, "fit_contours", fit)
    shot.fit()
    assert (shot.answer.number, shot.answer.edits) == (1, ())


def test_the_python_program_gives_the_same_numbers(session, registered):
    shot = session.shot
    shot.choose(1)
    assert "None" not in session.python(), "no defaults"
    pose = run_program(session, registered[1])["pose"]
    found = {name: double(pose[name]) for name in ("rotation", "translation")}
    assert rotation_error(found["rotation"], shot.answer.pose.rotation) < 0.1
    assert torch.allclose(found["translation"], shot.answer.pose.translation, rtol=1e-3)
    shot.place(shot.result.moved(shot.answer.pose.projection[0], rotation=(0, 6, 0)))
    assert f"'rotation': {shot.answer.pose.rotation.tolist()}" in session.python()
    request, boxes = shot.result.inputs
    elsewhere = replace(request, renderer="embree", device="cuda")
    shot.result = replace(shot.result, inputs=(elsewhere, boxes))
    assert ", renderer='embree', device='cuda')" in session.python()


@pytest.mark.parametrize("camera", slow_after(1, [UNCERTAIN, 49.6, "exif"]))
def test_the_python_program_knows_how_uncertain_the_focal_length_is(session, registered, camera):
    folder = registered[1]
    box = session.shot.box
    shutil.copy(folder / "photo.png", folder / "exif.png")
    with_exif(folder / "exif.png", exif(1, 38))
    session.open_photo(folder / "exif.png").set_box(box)
    session.set_camera(camera)
    session.register()
    found = run_program(session, folder)["result"]
    expected = session.shot.result.registration
    covariances = [one.hypotheses[0].covariance for one in (found, expected)]
    assert_close(*covariances, rtol=1e-3, atol=0.0)
    assert covariances[0].isfinite().all()
    assert found.camera.describe() == expected.camera.describe()


def test_the_python_program_says_what_boxes_are():
    options = RegisterOptions(pose="upright", box_is="visible")
    made = programs._pipeline(options)
    assert made == "cr.Pipeline().with_pose_prior('upright').with_boxes('visible')"


def test_move_without_a_camera_keeps_the_allocentric_rotation(session, monkeypatch):
    shot = session.shot
    registrar = shot.result.registrar
    monkeypatch.setattr(registrar, "mesh_is", "similar")  # no focal length is estimated
    session.set_camera()
    session.register()
    assert shot.result.registrar is registrar, "the views are not rendered again"
    before = shot.answer.pose
    T = shot.answer.pose.projection[0]
    shot.place(shot.result.moved(T, rotation=(0, 0, 5)))
    pose = shot.answer.pose
    assert pose.translation is None
    assert rotation_error(pose.rotation, before.rotation) == pytest.approx(5, abs=1e-3)
    # A translation keeps the rotation of the projection and changes the allocentric one.
    shot.place(shot.result.moved(pose.projection[0], translation=(0.1, 0, 0)))
    assert torch.equal(shot.answer.pose.projection[0][:3, :3], pose.projection[0][:3, :3])
    assert 0.1 < rotation_error(shot.answer.pose.rotation, pose.rotation) < 5
    assert session.document()["translation"] is None


def test_messages_use_the_names_of_the_user(folder):
    session = Session(RegisterOptions(), folder)
    paths = (folder / "cat.obj", "other/cat.obj", "")
    assert [session.name(path) for path in paths] == ["cat.obj", "other/cat.obj", ""]
    warning = CurviregWarning("large", subject=folder / "cat.obj")
    assert session.without_folders(str(warning)) == "cat.obj: large"
    with refused("choose a photograph and a mesh"):
        session.register()
    with refused("register first"):
        session.shot.fit()


def test_photographs_are_opened_chosen_and_closed(registered, monkeypatch):
    session, folder, _ = registered
    first = session.shot
    second = session.open_photo(folder / "photo.png")
    assert session.shot is second
    assert (second.box, second.result) == (None, None)
    session.shot = first
    assert session.request() == first.result.inputs[0]
    third = session.open_photo(folder / "photo.png")
    session.shot = first
    session.remove_photo(third)
    assert (session.shots, session.shot) == ([first, second], first)
    monkeypatch.setattr(module, "MAX_VIEWER_PHOTOGRAPHS", 2)
    with refused("2 photographs are open"):
        session.open_photo(folder / "photo.png")
    session.shot = second
    session.remove_photo(second)
    assert (session.shots, session.shot) == ([first], first)


def test_a_registrar_serves_requests_with_the_same_mesh_and_method(folder, monkeypatch):
    monkeypatch.setattr(
        module, "open_registrar", lambda options, meshes, **_: (options.pose, meshes)
    )
    request = replace(RegisterOptions(), meshes=(folder / "truck.ply",), pose="any")
    session = new_session()
    report = session.report_progress
    first = session.open_registrar(request, report)
    assert first == ("any", request.meshes)
    box = (1.0, 2.0, 30.0, 40.0)
    camera = (260.0, 260.0, 119.5, 89.5)
    other = replace(
        request,
        photos=(folder / "photo.png",),
        box=box,
        camera=camera,
        limits={"theta": (0.0, 9.0)},
    )
    assert session.open_registrar(other, report) is first
    assert session.open_registrar(replace(other, camera=60.0), report) is first
    for changes in ({"pose": "upright"}, {"meshes": (folder / "other.ply",)}):
        changed = replace(request, **changes)
        assert session.open_registrar(changed, report) == (changed.pose, changed.meshes)
    first = session.open_registrar(request, report)
    session.open_mesh(folder / "truck.ply")  # again: a material may have come beside it
    assert session.open_registrar(request, report) is not first


def test_the_box_of_a_detector_is_on_the_page(folder):
    (folder / "boxes.json").write_text('[{"image_id": "photo", "bbox": [60, 50, 80, 70]}]')
    session = new_session("photo.png", "truck.ply", "--boxes", "boxes.json")
    session.load()
    assert session.shot.box == (59.5, 49.5, 139.5, 119.5)
    assert session.request().boxes is None
    assert "--boxes" not in session.command(), "the command names the numbers"
    box = ["--box", "0.25", "0.25", "0.75", "0.5", "--box-format", "fractions"]
    session = new_session("photo.png", "truck.ply", *box)
    session.load()
    assert session.shot.box == (59.5, 44.5, 179.5, 89.5)
    assert session.request().box_format is None
    session = new_session("--boxes", "boxes.json")
    with refused("--boxes: needs a photograph"):
        session.load()


@pytest.mark.slow
def test_distortion_is_removed_from_all_photographs(folder):
    K = torch.tensor([[500.0, 0, 239.5], [0, 500.0, 179.5], [0, 0, 1]])
    session = new_session("photo.png", "truck.ply", "--pipeline", "small.json")  # 240 x 180 px
    session.set_camera(Camera(K, size=(360, 480)))
    session.load()
    plain = session.shot.photo
    assert (session.request().camera, plain.notes) == (pytest.approx((250, 250, 119.5, 89.5)), ())
    assert "--camera 250 250 119.5 89.5" in session.command()
    session.shot.set_box((10.0, 20.0, 90.0, 80.0))
    camera = Camera(K, (-0.3, 0.1, 0, 0, 0), size=(360, 480))
    box = ["--box", "10", "20", "90", "80"]
    (folder / "cam.json").write_text(
        json.dumps({"K": K.tolist(), "D": camera.distortion, "image_size": [480, 360]})
    )
    given = new_session("photo.png", "truck.ply", "--camera", "cam.json", *box)
    given.load()
    seen = undistorted(plain.image, camera, torch.tensor([10.0, 20, 90, 80]))
    assert torch.equal(given.shot.photo.image, seen.image)
    assert given.shot.box == pytest.approx(seen.box.tolist(), abs=0.06), (
        "px of the photograph as it was taken"
    )
    with refused("--box: needs a photograph"):
        new_session(*box).load()
    session.set_camera(camera)
    assert torch.equal(session.shot.photo.image, seen.image)
    assert session.shot.photo.notes == ("undistorted",)
    assert (session.shot.box, session.command()) == (None, ""), "boxes were of other pixels"
    session.open_photo(folder / "photo.png")
    assert session.shot.photo.notes == ("undistorted",)
    session.shot.set_box(tuple(scene(0)[1].tolist()))
    session.register()
    document = session.document()
    assert (document["inputs"]["camera_source"], document["camera"]) == (
        "file",
        camera.at((180, 240)).describe(),
    )
    assert "cr.register(cr.geometry.undistorted(cr.data.read_photo(" in session.python()
    session.set_camera((250.0, 250.0, 119.5, 89.5))
    assert [torch.equal(shot.photo.image, plain.image) for shot in session.shots] == [True, True]


def test_command_contains_inputs_options_and_the_limits_on_the_pose(folder):
    words = ["--pose", "any", "--box-is", "visible", "--preset", "fast"]
    session = new_session("--unit", "mm", "--up=-y", *words)
    session.open_photo(Path("photo.png")).set_box((10.0, 20.5, 90.0, 80.0))
    session.set_camera("exif")
    assert session.command() == (
        "curvireg register photo.png MESH --box 10 20.5 90 80 --camera exif "
        "--unit mm --up=-y --pose any --box-is visible --preset fast --out result"
    )
    session.set_camera((300.0, 300.5, 119.5, 89.5))
    assert "--camera 300 300.5 119.5 89.5 --unit" in session.command()
    session.set_camera(65.0)
    assert "--box 10 20.5 90 80 --fov 65 --unit" in session.command()
    session.set_camera(UNCERTAIN)
    assert session.command() == "", "four numbers would be those of a known focal length"
    session.options = replace(session.options, unit="m", camera=180.0)
    session.open_mesh(folder / "truck.ply")
    with refused("180"):
        session.register()
    words = "--near 10 -20.5 --within 30 --front=-x --distance 0.5 2 --fov 65"
    session = new_session(*words.split())
    session.set_limits(azimuth=(315.0, 45.0), elevation=(-10.0, 40.0))
    again = register_options(parse(shlex.split(session.command())[1:]))
    assert (again.limits, again.camera) == (session.request().limits, 65)
    assert again.limits["viewpoint"] == (10.0, -20.5, 0.0)
    session.set_limits(**{**dict.fromkeys(session.options.limits), "front": "y"})
    assert "--front" not in session.command(), "it limits nothing by itself"


def test_names_of_files_are_no_options():
    options = RegisterOptions(photos=(Path("-p.png"),), meshes=(Path("--t.ply"),))
    for rig, first in (("", "./-p.png"), ("-rig.csv", "--views ./-rig.csv")):
        command = programs.command_line(options, str, rig)
        assert command == f"curvireg register {first} ./--t.ply --out result"


@pytest.mark.usefixtures("folder")
def test_register_is_cancelled_by_the_user():
    box = map(str, scene(0)[1].tolist())
    session = new_session("photo.png", "truck.ply", "--pipeline", "small.json", "--box", *box)
    session.load()
    session.cancelled = True
    with refused(r"^stopped$", CurviregError):
        session.register()
    assert (session.shot.result, session.cancelled) == (None, False)
    assert session.progress[0] == "bank", "at the first step"


DRAGS = """
null             | [60, 50]   | [10, 20.26] | [10, 20.3, 60, 50]
[10, 20, 60, 50] | [200, 200] | [201, 202]  | [10, 20, 60, 50]
[10, 20, 60, 50] | [11, 35]   | [5, 99]     | [5, 20, 60, 50]
[10, 20, 60, 50] | [30, 19]   | [0, 25]     | [10, 25, 60, 50]
[10, 20, 60, 50] | [59, 51]   | [80, 90]    | [10, 20, 80, 90]
[10, 20, 60, 50] | [30, 35]   | [35, 25]    | [15, 10, 65, 40]
[10, 20, 60, 50] | [100, 100] | [120, 130]  | [100, 100, 120, 130]
[10, 20, 60, 50] | [10, 35]   | [90, 35]    | [60, 20, 90, 50]
[10, 10, 16, 16] | [15.5, 13] | [30, 13]    | [10, 10, 30, 16]
"""


@pytest.mark.parametrize(("box", "start", "end", "expected"), text_table(DRAGS))
def test_a_drag_draws_moves_and_resizes_boxes(box, start, end, expected):
    found = dragged_box(box and tuple(box), tuple(start), tuple(end), reach=4.0)
    assert found == tuple(expected)


@pytest.fixture
def pose(session):
    """A result, its pose and camera, and the mesh's centre and radius."""
    result = session.shot.result
    return result, *result.registration.projection, result.registrar.describer


def seen(T, K, point):
    at = K @ (T[:3, :3] @ point + T[:3, 3])
    return at[:2] / at[2]


def test_the_mesh_follows_the_mouse_its_wheel_and_two_fingers(pose):
    result, T, K, describer = pose
    moved = result.dragged(T, K, (100.0, 80.0), (112.0, 75.0), turns=False)
    shift = seen(moved, K, describer.centre) - seen(T, K, describer.centre)
    assert_close(shift, double([12.0, -5.0]))
    assert torch.equal(moved[:3, :3], T[:3, :3])
    near = T[:3, :3].T @ double([0, 0, -describer.radius]) + describer.centre
    turned = result.dragged(T, K, (0.0, 0.0), (4.0, 3.0), turns=True)
    shift = seen(turned, K, near) - seen(T, K, near)
    assert 4 < shift[0] < 8, "right and down, a little more than the mouse, as it is nearer"
    assert 3 < shift[1] < 6
    assert_close(seen(turned, K, describer.centre), seen(T, K, describer.centre))
    moved = result.scaled(T, 1.25, roll=30.0)
    centres = [P[:3, :3] @ describer.centre + P[:3, 3] for P in (T, moved)]
    assert_close(centres[1], centres[0] / 1.25)
    assert rotation_error(moved[:3, :3], T[:3, :3]) == pytest.approx(30, abs=1e-4)
    # Clockwise on the screen: what is right of the centre goes down.
    right = T[:3, :3].T @ double([describer.radius, 0, 0]) + describer.centre
    assert seen(moved, K, right)[1] > seen(T, K, right)[1]
    with refused("touch the camera"):
        result.scaled(T, 1000.0)


@pytest.mark.parametrize("azimuth", [0.0, 45.0, 90.0, 135.0, 180.0, 200.0, 315.0])
@pytest.mark.parametrize("elevation", [-30.0, 0.0, 60.0])
def test_a_hint_is_the_side_from_which_the_model_is_seen(azimuth, elevation):
    """The camera of that viewpoint stands where the hint was taken, in the frame of limits."""
    R = rotation_from_viewpoint(*(double(angle) for angle in (azimuth, elevation, 0.0)))
    position = R.mT @ double([0.0, 0.0, -3.0])
    session = Session(RegisterOptions(limits={"front": "x"}), Path("uploads"))
    session.hint_direction(position.tolist())
    assert session.options.limits["viewpoint"] == pytest.approx((azimuth, elevation, 0.0), abs=0.06)
    assert (session.options.limits["within"], session.options.limits["front"]) == (WITHIN, "x")
