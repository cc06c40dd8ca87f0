"""``curvireg register`` with unknown cameras: guessed only on request."""

import json
import math

import cv2
import pytest
import torch

from curvireg_torch.cli import main
from tests._support.exif import exif, with_exif
from tests._support.lists import CAMERA, box_of, lines, written
from tests._support.scenes import scene


@pytest.fixture(scope="module", autouse=True)
def _exif_photographs(folder):
    """The scenes have a focal length of 260 px at 240 x 180: 37.5 mm over the diagonal, 49.55 degrees across."""
    for suffix in ("jpg", "png"):
        cv2.imwrite(str(folder / f"exif.{suffix}"), cv2.imread(str(folder / "photos" / "0.png")))
        with_exif(folder / f"exif.{suffix}", exif(1, 38))


@pytest.fixture
def register(folder, capsys):
    """Register one photograph; returns the document and what was printed beside it."""

    def run(photo, *words):
        files = [str(folder / photo), str(folder / "learned.safetensors"), "--box", *box_of(0)]
        assert main(["register", *files, *words, "--json", "--quiet"]) == 0
        printed = capsys.readouterr()
        return json.loads(printed.out), printed.err

    return run


def test_exif_camera_gives_a_translation_without_covariance(register):
    known, _ = register("exif.png", "--camera", *CAMERA)
    assert known["inputs"]["camera_source"] == "given"
    assert known["covariance"] is not None
    guessed, printed = register("exif.png", "--camera", "exif")
    focal = 38 / math.hypot(36, 24) * math.hypot(240, 180)
    assert guessed["inputs"]["camera"] == pytest.approx([focal, focal, 119.5, 89.5])
    assert guessed["inputs"]["camera_source"] == "exif"
    assert guessed["covariance"] is guessed["standard_deviations"] is None
    assert f"camera guessed, focal length {focal:.0f} px" in printed
    t, truth = torch.tensor(guessed["translation"], dtype=torch.float64), scene(0)[2][:3, 3]
    assert float((t - truth).norm() / truth.norm()) < 0.1


def test_fov_is_the_horizontal_field_of_view(register):
    guessed, _ = register("photos/0.png", "--fov", str(2 * math.degrees(math.atan(120 / 260))))
    assert guessed["inputs"]["camera"] == pytest.approx([260, 260, 119.5, 89.5])
    assert guessed["inputs"]["camera_source"] == "fov"
    known, _ = register("photos/0.png", "--camera", *CAMERA)
    torch.testing.assert_close(torch.tensor(guessed["rotation"]), torch.tensor(known["rotation"]), atol=1e-3, rtol=0)


def test_exif_is_ignored_by_default(register):
    result, _ = register("exif.jpg")
    assert result["translation"] is result["inputs"]["camera"] is result["inputs"]["camera_source"] is None


def test_guesses_apply_to_rows_without_a_camera(folder, tmp_path, capsys):
    rows = [["exif.png", *CAMERA], ["exif.png", *[""] * 4], ["photos/0.png", *[""] * 4]]
    path = written(folder / "cameras.csv", "photo,fx,fy,cx,cy,x0,y0,x1,y1", *[[*row, *box_of(0)] for row in rows])
    words = ["register", "--list", str(path), str(folder / "truck.safetensors"), "--quiet", "--no-refine"]
    assert main([*words, "--out", str(tmp_path), "--camera", "exif"]) == 0
    assert "guessed" in capsys.readouterr().err
    known, guessed, failed = lines(tmp_path)
    assert [line["inputs"]["camera_source"] for line in (known, guessed)] == ["given", "exif"]
    assert guessed["translation"] is not None
    assert "no focal length" in failed["message"]
    # Another guess is another request.
    assert main([*words, "--out", str(tmp_path), "--fov", "50"]) == 0
    assert [line["inputs"]["camera_source"] for line in lines(tmp_path)] == ["given", "fov", "fov"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        *[([f"--fov={degrees}"], "fov: expected 0 < degrees < 180") for degrees in ("0", "180", "-40")],
        (["--camera", "0", "260", "120", "90"], "FX, FY > 0"),
        (["--camera", "260", "-260", "120", "90"], "FX, FY > 0"),
        (["--camera", "130", "260", "120", "90"], "--camera: expected square pixels"),
    ],
)
def test_check_camera_refuses_unusable_values_before_reading(folder, refused, monkeypatch, words, message):
    monkeypatch.setattr("curvireg_torch.data.read_photo", lambda *_, **__: pytest.fail("read"))
    files = [str(folder / "photos" / "0.png"), str(folder / "truck.safetensors")]
    refused(main(["register", *files, "--json", *words]), message)
