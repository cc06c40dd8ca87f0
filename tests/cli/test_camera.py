"""``curvireg register`` without a camera: guessed when asked, and said so."""

import json
import math

import cv2
import pytest
import torch

from curvireg_torch.cli import main
from tests._support.exif import exif, with_exif
from tests._support.lists import CAMERA, box_of, lines, write_files, written
from tests._support.scenes import scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The scenes are taken with 260 px at 240 x 180: 37.5 mm over the diagonal, 49.55 degrees across."""
    folder = write_files(tmp_path_factory.mktemp("camera"))
    for suffix in ("jpg", "png"):
        cv2.imwrite(str(folder / f"told.{suffix}"), cv2.imread(str(folder / "photos" / "0.png")))
        with_exif(folder / f"told.{suffix}", exif(1, 38))
    return folder


def registered(folder, photo, *words):
    files = [str(folder / photo), str(folder / "truck.safetensors"), "--box", *box_of(0)]
    assert main(["register", *files, *words, "--json", "--quiet"]) == 0


def test_exif_gives_a_distance_and_no_covariance(folder, capsys):
    registered(folder, "told.png", "--camera", *CAMERA)
    given = json.loads(capsys.readouterr().out)
    assert given["inputs"]["camera_source"] == "given"
    assert given["covariance"] is not None
    registered(folder, "told.png", "--camera", "exif")
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    focal = 38 / math.hypot(36, 24) * math.hypot(240, 180)
    assert found["inputs"]["camera"] == pytest.approx([focal, focal, 119.5, 89.5])
    assert found["inputs"]["camera_source"] == "exif"
    assert found["covariance"] is None
    assert found["standard_deviations"] is None
    assert f"camera guessed, focal length {focal:.0f} px" in printed.err
    t = torch.tensor(found["translation"], dtype=torch.float64)
    truth = scene(0)[2][:3, 3]
    assert float((t - truth).norm() / truth.norm()) < 0.1


def test_degrees_across_the_width(folder, capsys):
    fov = 2 * math.degrees(math.atan(120 / 260))
    registered(folder, "photos/0.png", "--fov", str(fov))
    found = json.loads(capsys.readouterr().out)
    assert found["inputs"]["camera"] == pytest.approx([260, 260, 119.5, 89.5])
    assert found["inputs"]["camera_source"] == "fov"
    registered(folder, "photos/0.png", "--camera", *CAMERA)
    given = json.loads(capsys.readouterr().out)
    torch.testing.assert_close(torch.tensor(found["rotation"]), torch.tensor(given["rotation"]), atol=1e-3, rtol=0)


def test_nothing_is_guessed_unasked(folder, capsys):
    registered(folder, "told.jpg")
    found = json.loads(capsys.readouterr().out)
    assert found["translation"] is found["inputs"]["camera"] is found["inputs"]["camera_source"] is None


def test_guesses_are_of_rows_without_a_camera(folder, capsys):
    rows = [["told.png", *CAMERA], ["told.png", *[""] * 4], ["photos/0.png", *[""] * 4]]
    path = written(folder / "list.csv", "photo,fx,fy,cx,cy,x0,y0,x1,y1", *[[*row, *box_of(0)] for row in rows])
    words = ["register", "--list", str(path), str(folder / "truck.safetensors"), "--quiet", "--no-refine"]
    assert main([*words, "--out", str(folder / "out"), "--camera", "exif"]) == 0
    assert "guessed" in capsys.readouterr().err
    given, guessed, untold = lines(folder / "out")
    assert given["inputs"]["camera_source"] == "given"
    assert guessed["inputs"]["camera_source"] == "exif"
    assert guessed["translation"] is not None
    assert untold["status"] == "failed"
    assert "no focal length" in untold["message"]
    # Another guess is another request.
    assert main([*words, "--out", str(folder / "out"), "--fov", "50"]) == 0
    sources = [line["inputs"]["camera_source"] for line in lines(folder / "out")]
    assert sources == ["given", "fov", "fov"]


@pytest.mark.parametrize("degrees", ["0", "180", "nan", "-40"])
def test_angles_that_are_none(folder, capsys, degrees):
    files = [str(folder / "photos" / "0.png"), str(folder / "truck.safetensors")]
    assert main(["register", *files, f"--fov={degrees}", "--json"]) == 2
    assert "fov: expected 0 < degrees < 180" in capsys.readouterr().err


def test_one_camera_is_enough(capsys):
    with pytest.raises(SystemExit):
        main(["register", "a.jpg", "b.stl", "--json", "--camera", "exif", "--fov", "50"])
    assert "expected one of --camera" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (["0", "260", "120", "90"], "FX, FY > 0"),
        (["260", "-260", "120", "90"], "FX, FY > 0"),
        (["260", "nan", "120", "90"], "finite"),
        (["130", "260", "120", "90"], "--camera: expected square pixels"),
    ],
)
def test_cameras_that_are_none(folder, capsys, camera, message):
    files = [str(folder / "photos" / "0.png"), str(folder / "truck.safetensors")]
    assert main(["register", *files, "--json", "--camera", *camera]) == 2
    assert message in capsys.readouterr().err
