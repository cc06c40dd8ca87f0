"""``curvireg register`` with unknown cameras, calibration files and masks."""

import json
import math
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

import curvireg_torch as cr
from curvireg_torch import Camera, Registration, camera_matrix
from curvireg_torch.cli import main
from curvireg_torch.cli import register as of_register
from curvireg_torch.cli.register import NONE_RELIABLE, SOME_FAILED
from curvireg_torch.data import images
from curvireg_torch.errors import InvalidInputError
from tests._support import scene, write_photo
from tests._support.exif import exif, with_exif
from tests._support.lists import CAMERA, box_of, check_pose, lines, written
from tests.registration.test_cameras_and_masks import distorted


@pytest.fixture(scope="module", autouse=True)
def _exif_photographs(folder):
    """The scenes have a focal length of 260 px at 240 x 180: 37.5 mm over the diagonal, 49.55
    degrees across."""
    cv2.imwrite(str(folder / "exif.png"), cv2.imread(str(folder / "photos" / "0.png")))
    with_exif(folder / "exif.png", exif(1, 38))


@pytest.fixture
def register_photo(registered, capsys):
    """Register one photograph; returns the document and what was printed."""

    def run(photo, *words):
        found = registered(*words, photo=photo, mesh="learned.safetensors")
        return found, capsys.readouterr().out

    return run


@pytest.mark.slow
def test_guessed_cameras_give_a_translation_and_its_covariance(
    register_photo,
):
    guessed, printed = register_photo("exif.png", "--camera", "exif")
    focal = 38 / math.hypot(36, 24) * math.hypot(240, 180)
    assert guessed["inputs"]["camera"] == pytest.approx([focal, focal, 119.5, 89.5])
    assert guessed["inputs"]["camera_source"] == "exif"
    assert guessed["camera_source"] == "exif"
    assert guessed["covariance"] is not None
    assert 0.0 < guessed["camera"]["focal_deviation"] <= 0.05
    assert guessed["camera"]["matrix"][0][0] == pytest.approx(focal, rel=0.2)
    assert "camera: from the file's EXIF, 38 mm" in printed
    unasked, _ = register_photo("exif.png")
    assert (unasked["camera"], unasked["translation"]) == (
        guessed["camera"],
        guessed["translation"],
    )
    check_pose(guessed, scene(0)[2], 15.0, 0.1)
    # horizontal
    guessed, printed = register_photo(
        "photos/0.png", "--fov", str(2 * math.degrees(math.atan(120 / 260)))
    )
    assert guessed["inputs"]["camera"] == pytest.approx([260, 260, 119.5, 89.5])
    assert guessed["inputs"]["camera_source"] == "fov"
    assert "camera: field of view given, focal length 1." in printed
    check_pose(guessed, scene(0)[2], 3.0, 0.1)


def test_without_a_camera_the_focal_length_is_estimated(register_photo):
    found, printed = register_photo("photos/0.png")
    assert found["camera_source"] == "estimated"
    assert found["inputs"]["camera_source"] is found["inputs"]["camera"] is None
    assert "camera: focal length estimated" in printed
    assert "the distance is proportional to it" in printed


def test_guesses_apply_to_rows_without_a_camera(folder, register, tmp_path):
    rows = [["exif.png", *CAMERA], ["exif.png", *[""] * 4], ["photos/0.png", *[""] * 4]]
    rows = [[*row, *box_of(0)] for row in rows]
    path = written(folder / "cameras.csv", "photo,fx,fy,cx,cy,x0,y0,x1,y1", *rows)
    assert register("--list", path, folder / "truck.safetensors", "--camera", "exif") == 0
    known, guessed, failed = lines(tmp_path / "out")
    assert [line["inputs"]["camera_source"] for line in (known, guessed)] == ["given", "exif"]
    assert guessed["translation"] is not None
    assert "no focal length" in failed["message"]


@pytest.fixture(scope="module")
def lens(folder):
    """A photograph that a lens with distortion took, its calibration and mask; returns its box and
    the true pose."""
    camera = Camera(
        camera_matrix(260.0, 260.0, 20.0, 30.0), (-0.25, 0.1, 0.0, 0.0, 0.0), size=(180, 240)
    )
    calibration = {
        "mtx": camera.matrix.tolist(),
        "dist": camera.distortion,
        "image_size": [240, 180],
    }
    _, photo, box, mask, T = distorted(camera, 1)
    write_photo(folder / "distorted.png", photo)
    cv2.imwrite(str(folder / "mask.png"), (255 * mask).round().byte().numpy())
    (folder / "cam.json").write_text(json.dumps(calibration))
    return [str(v) for v in box.tolist()], T


def test_a_photograph_is_decoded_and_undistorted_once_for_all_meshes(
    folder, lens, register, monkeypatch
):
    decode = Mock(wraps=images.opened_picture)
    remap = Mock(wraps=cv2.remap)
    monkeypatch.setattr(images, "opened_picture", decode)
    monkeypatch.setattr(cv2, "remap", remap)
    words = ["--mesh", folder / "truck.safetensors"] * 2
    words += ["--box", *lens[0], "--camera", folder / "cam.json"]
    assert register(folder / "distorted.png", *words) == 0
    assert decode.call_count == 1
    assert remap.call_count == 3  # red, green and blue


def test_calibration_file_removes_the_distortion(folder, lens, tmp_path, registered):
    box, T = lens
    files = {"photo": "distorted.png", "mesh": "learned.safetensors"}
    words = ["--camera", folder / "cam.json", "--format", "ros"]
    found = registered(*words, **files, box=box)
    check_pose(found, T, 3.0, 0.03)
    assert found["covariance"] is not None
    assert (found["camera"]["distortion"][0], found["camera"]["size"]) == (-0.25, [180, 240])
    assert found["inputs"]["camera_source"] == "file"
    assert found["inputs"]["box"] != [float(v) for v in box]
    assert np.array(found["T_cam_from_model"])[:3, 3].tolist() == found["translation"]
    assert "frame_id: camera_optical_frame" in (tmp_path / "out" / "pose.yaml").read_text()


def test_lists_take_calibration_files_and_masks(folder, lens, tmp_path):
    box, T = lens
    rows = [
        ["distorted.png", *box, "cam.json", ""],
        ["distorted.png", *[""] * 4, "cam.json", "mask.png"],
    ]
    rows += [["distorted.png", *box, "none.yaml", ""], ["distorted.png", *box, "", "none.png"]]
    path = written(folder / "calibrated.csv", "photo,x0,y0,x1,y1,camera,mask", *rows)
    words = ["register", "--list", str(path), str(folder / "learned.safetensors")]
    assert main([*words, "--quiet", "--out", str(tmp_path), "--strict"]) == SOME_FAILED
    boxed, masked, *failed = lines(tmp_path)
    for row in (boxed, masked):
        check_pose(row, T, 3.0, 0.03)
    assert masked["inputs"]["box"] == pytest.approx(boxed["inputs"]["box"], abs=3.0)
    assert "none.yaml: no such file" in failed[0]["message"]
    assert "none.png" in failed[1]["message"]


def test_strict_tells_by_the_exit_code_whether_what_is_needed_is_reliable(
    folder, register_one, register, tmp_path, monkeypatch
):
    """tests/cli/test_views.py has the verdict of a registration."""
    for verdict, need, code in (
        ("reliable", [], 0),
        ("reliable axis", [], NONE_RELIABLE),
        ("reliable axis", ["--need", "pose"], NONE_RELIABLE),
        ("reliable axis", ["--need", "axis"], 0),
        ("reliable", ["--need", "axis"], 0),
        ("unsure", ["--need", "axis"], NONE_RELIABLE),
    ):
        monkeypatch.setattr(of_register, "_register_alone", lambda _, verdict=verdict: verdict)
        assert register_one("--strict", *need) == code
    with pytest.raises(SystemExit):  # without --strict
        register_one("--need", "axis")
    listed = tmp_path / "list.csv"
    words = ["--list", listed, folder / "truck.safetensors", "--strict", "--need", "axis"]
    for verdict, names, code in (
        ("reliable axis", ["0.png"], 0),
        ("unsure", ["0.png", "none.png"], NONE_RELIABLE),
    ):
        rows = [[folder / "photos" / name, *box_of(0), *CAMERA] for name in names]
        written(listed, "photo,x0,y0,x1,y1,fx,fy,cx,cy", *rows)
        monkeypatch.setattr(Registration, "verdict", verdict)
        assert register(*words, out=verdict) == code


def test_the_command_line_names_the_options_that_help(folder, register_one, refused):
    """The library, which others call from Python, does not know them."""
    refused(
        register_one("--camera", "exif"),
        "no focal length in its EXIF; give the camera in another way: --camera FX FY CX CY, "
        "--camera FILE (a calibration) or --fov DEG",
    )
    photo = folder / "photos" / "0.png"
    with pytest.raises(InvalidInputError, match="no focal length") as error:
        cr.register(photo, folder / "truck.safetensors", box=box_of(0), camera="exif")
    assert error.value.kind == "camera exif"
    assert "--" not in str(error.value).replace(str(photo), "")
    refused(
        register_one("--camera", folder / "none.yaml"), "without a calibration, use --camera exif"
    )
