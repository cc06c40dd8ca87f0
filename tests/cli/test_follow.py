import json
import math
import pickle
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from torch.testing import assert_close

from curvireg_torch import data
from curvireg_torch.cli import following, main
from curvireg_torch.cli.following import Tally
from curvireg_torch.data import Photo, Video
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.formats.poses import PoseRecord
from curvireg_torch.geometry import Camera, camera_matrix, rotation_from_axis_angle
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.jobs.outputs import MARKER
from curvireg_torch.pipeline import Pipeline
from curvireg_torch.registration import FailedRegistration, Follower
from curvireg_torch.visualization import OverlayVideo
from tests._support import (
    double,
    eye,
    learned_registrar,
    sequence,
    slow_after,
    write_photo,
    write_video,
)
from tests._support.calibrations import calibration
from tests._support.exif import exif, with_exif
from tests._support.lists import CAMERA, check_pose, table
from tests._support.results import registration
from tests._support.spies import spied
from tests._support.tables import text_table

SURE = registration(0.01 * eye(6))


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("follow")
    learned_registrar().bank.save(folder / "truck.safetensors")
    (folder / "shots").mkdir()
    scenes = sequence(3)
    images = [image for image, _, _ in scenes]
    for k, image in enumerate(images):
        write_photo(folder / "shots" / f"{k}.png", image)
    write_video(folder / "turn.avi", images, rate=25.0)
    with_exif(folder / "shots" / "0.png", exif(1, 38))
    (folder / "shots" / "3.png").write_bytes(b"no photograph")
    T = scenes[0][2]
    start = {"rotation": T[:3, :3].tolist(), "translation": T[:3, 3].tolist()}
    (folder / "start.json").write_text(json.dumps(start))
    return folder, scenes


def check_poses(folder, frames, degrees=4.0, share=0.04):
    """Check the poses of the frames in a folder's results; returns the rows."""
    rows = table(folder)
    for row, (_, _, T) in zip(rows, frames[1], strict=False):
        check_pose(row, T, degrees, share)
    return rows


@pytest.fixture
def follow(frames, tmp_path):
    """Run ``curvireg follow``, by default on the folder, with the camera and the box of the first
    frame, or from its pose, which is quicker; results go to ``tmp_path / out``."""
    folder, scenes = frames

    def run(*options, source="shots", camera=CAMERA, box=True, start=False, out=""):
        source = folder / source if (folder / source).exists() else source
        place = ["--box", *scenes[0][1].tolist()] if box else []
        place = ["--start", folder / "start.json"] if start else place
        known = ["--camera", *camera] if camera else []
        words = [source, folder / "truck.safetensors", *known, *place, "--out", tmp_path / out]
        return main(["follow", "--quiet", *map(str, [*words, *options])])

    return run


DOUBTS = """
[0.1, 0.2, 0.409, 0.3] | ["", "", "not sure of the object yet (best confidence 0.40)", ""]
[0.1, 0.5, 0.3, 0.3]   | ["", "", "", ""]
[0.1, null, null]      | ["", "", "not sure of the object yet (best confidence 0.10)"]
[null, null, null]     | ["", "", "not sure of the object yet"]
"""


@pytest.mark.parametrize(("confidences", "said"), text_table(DOUBTS))
def test_frames_without_a_certain_pose_are_spoken_of_once(confidences, said):
    tally = Tally()
    for confidence, words in zip(confidences, said, strict=True):
        tally.add({"verdict": "unsure", "confidence": confidence}, 1.0)
        assert tally.doubt() == (words and f"{words}; give --box, or --start near the pose")


def test_follow_says_that_it_is_not_sure(follow, monkeypatch, capsys):
    monkeypatch.setattr(Follower, "__call__", lambda *_: registration(confidence=0.1))
    follow()
    error = capsys.readouterr().err
    assert error.count("curvireg: not sure of the object yet (best confidence 0.10)") == 1


def test_follow_writes_a_pose_for_each_frame(frames, follow, tmp_path, capsys, monkeypatch):
    """At once: a process that is killed leaves the poses before."""
    _, scenes = frames
    rows = []
    add = OverlayVideo.add

    def watched(*arguments):
        rows.append(len(table(tmp_path)))
        add(*arguments)

    monkeypatch.setattr(OverlayVideo, "add", watched)
    assert follow() == 0
    assert rows == [1, 2, 3, 4]
    closing = capsys.readouterr().out
    assert "4 frames: 3 reliable, 0 unsure, 0 no match, 0 lost, 1 failed" in closing
    rate = re.search(r", ([\d.]+) frames per second; see", closing)
    assert rate is not None
    assert float(rate[1]) > 0.0
    rows = check_poses(tmp_path, frames)
    assert [row["verdict"] for row in rows] == ["reliable"] * 3 + ["failed"]
    assert all(0.5 <= float(row["confidence"]) <= 1.0 for row in rows[:3])
    assert (rows[3]["r11"], rows[3]["confidence"], rows[0]["message"]) == ("", "", "")
    assert "3.png" in rows[3]["message"]
    pictures = [image.int() for _, image in Video(tmp_path / "overlay.mp4")]
    assert [tuple(image.shape) for image in pictures] == [(3, 180, 240)] * 4
    # contours and codec
    assert 2 < (pictures[2] - (scenes[2][0] * 255).int()).abs().float().mean() < 30


@pytest.fixture
def boxes(monkeypatch):
    """A function that returns the boxes that a follower was given."""
    calls = spied(monkeypatch, Follower, "__call__")
    return lambda: [box for _, _, box in calls]


def test_follow_reads_a_video_keeps_its_rate_and_prints_poses(
    frames, follow, boxes, tmp_path, capsys
):
    assert follow("--json", source="turn.avi") == 0
    assert boxes() == [frames[1][0][1].tolist(), None, None]
    printed = capsys.readouterr()
    assert "3 frames: 3 reliable, 0 unsure" in printed.err
    lines = [json.loads(line) for line in printed.out.splitlines()]
    rows = table(tmp_path)
    assert [row["photo"] for row in rows] == [f"turn-00000{k}" for k in range(3)]
    for line, row in zip(lines, rows, strict=True):
        assert (line["frame"], line["verdict"]) == (row["photo"], row["verdict"])
        assert line["confidence"] == float(row["confidence"])
        assert line["translation"] == [float(row[name]) for name in ("tx", "ty", "tz")]
        assert len(line["quaternion"]) == 4
    assert [line["seconds"] for line in lines] == sorted(line["seconds"] for line in lines)
    assert Video(tmp_path / "overlay.mp4").fps == 25.0
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {MARKER, "overlay.mp4", "results.csv"}


def test_an_animation_is_no_video(follow, tmp_path, capsys):
    """Of which one picture would be followed."""
    frames = [Image.new("RGB", (64, 48), (80 * k, 90, 90)) for k in range(3)]
    frames[0].save(tmp_path / "turn.webp", save_all=True, append_images=frames[1:])
    assert follow(source=tmp_path / "turn.webp", camera=(), box=False) != 0
    assert "an animation; save it as MP4" in capsys.readouterr().err


@pytest.mark.slow
def test_follow_takes_the_boxes_of_a_detector_by_frame(frames, follow, boxes, tmp_path):
    scenes = frames[1]
    x0, y0, x1, y1 = (
        (v + 0.5) / side for v, side in zip(scenes[0][1], (240, 180) * 2, strict=True)
    )
    yolo = f"0 {(x0 + x1) / 2} {(y0 + y1) / 2} {x1 - x0} {y1 - y0}\n"
    labels = tmp_path / "labels"
    labels.mkdir()
    (labels / "turn_1.txt").write_text(yolo)  # as ultralytics counts
    (labels / "turn-000002.txt").write_text("0 0.5 0.5 0.5 0.5\n")
    assert follow("--boxes", labels, source="turn.avi", box=False, out="out") == 0
    expected = pytest.approx(scenes[0][1].tolist(), abs=1e-3)
    assert boxes() == [expected, None, [59.5, 44.5, 179.5, 134.5]]
    check_pose(table(tmp_path / "out")[0], scenes[0][2], 4.0, 0.04)
    numbers = yolo.split()[1:]
    words = ["--box", *numbers, "--box-format", "yolo"]
    assert follow(*words, source="turn.avi", box=False, out="more") == 0
    assert boxes()[3:] == [expected, None, None]


def test_boxes_of_stored_pixels_are_turned_with_their_frame(tmp_path):
    image = {"id": 1, "file_name": "0.jpg", "height": 48, "width": 64}
    box = {"image_id": 1, "bbox": [0, 0, 10, 20]}
    (tmp_path / "boxes.json").write_text(json.dumps({"images": [image], "annotations": [box]}))
    options = RegisterOptions([Path("0.jpg")], [], boxes=str(tmp_path / "boxes.json"))
    turned = Photo(torch.zeros(3, 64, 48, dtype=torch.uint8), orientation=6)
    assert following._box(options, "0.jpg", turned, is_first=True) == [27.5, -0.5, 47.5, 9.5]


@pytest.mark.parametrize("source", slow_after(1, ["rtsp://camera/stream", "0"]))
def test_follow_live_drops_frames_that_are_late(frames, follow, tmp_path, monkeypatch, source):
    """A video file in the place of a camera, which delivers as fast as it can."""
    opened = []
    capture = cv2.VideoCapture
    file = str(frames[0] / "turn.avi")

    def open_capture(name):
        if Path(str(name)).is_relative_to(tmp_path):  # the overlay, read again when it is written
            return capture(name)
        opened.append(name)
        return capture(file)

    monkeypatch.setattr(cv2, "VideoCapture", open_capture)
    assert follow(source=source, start=True) == 0
    assert opened == [0 if source == "0" else source]
    names = [row["photo"] for row in table(tmp_path)]
    assert len(names) < 3
    assert names[-1] == "frame-000002"


@pytest.mark.parametrize("words", slow_after(1, ["--fov 49.55", "--camera exif"]))
def test_follow_guesses_the_camera_from_the_first_frame(
    frames, follow, tmp_path, words, monkeypatch
):
    read = Mock(wraps=data.read_photo)
    monkeypatch.setattr(following, "read_photo", read)
    assert follow(*words.split(), camera=()) == 0
    assert [call.args[0].name for call in read.call_args_list] == [f"{k}.png" for k in range(4)]
    check_poses(tmp_path, frames)


@pytest.mark.parametrize("kind", slow_after(1, ["file", "exif"]))
def test_frames_of_another_size_scale_the_camera(frames, follow, tmp_path, kind):
    """As photographs of a list do; a turned frame fails, and the others are followed."""
    folder, scenes = frames
    shots = tmp_path / "shots"
    shots.mkdir()
    first, second = (cv2.imread(str(folder / "shots" / f"{k}.png")) for k in (0, 1))
    shutil.copy(folder / "shots" / "0.png", shots)  # has EXIF data
    cv2.imwrite(str(shots / "1.png"), cv2.resize(second, None, fx=2.0, fy=2.0))
    cv2.imwrite(str(shots / "2.png"), cv2.rotate(first, cv2.ROTATE_90_CLOCKWISE))
    file = tmp_path / "camera.json"
    file.write_text(calibration(260.0, 119.5, 89.5, image_width=240, image_height=180))
    camera = [file if kind == "file" else "exif"]
    assert follow(source=shots, camera=camera, out="out") == 0
    rows = table(tmp_path / "out")
    for row, (_, _, T) in zip(rows[:2], scenes, strict=False):
        check_pose(row, T, 4.0, 0.04)
    assert "turn the photograph by 90 degrees" in rows[2]["message"]


def test_a_calibration_without_a_size_is_of_frames_as_large_as_the_first(monkeypatch):
    """A lens that distorts, in frames of which the second is twice as large."""
    remove = Mock(wraps=following.undistorted)
    monkeypatch.setattr(following, "undistorted", remove)
    monkeypatch.setattr(following, "Follower", Mock())
    camera = Camera(camera_matrix(60.0, 60.0, 39.5, 29.5), distortion=(-0.3, 0.1, 0.0, 0.0))
    pixels = torch.arange(80.0).expand(3, 60, 80) / 80.0
    larger = torch.nn.functional.interpolate(pixels[None], scale_factor=2, mode="bilinear")[0]
    frames = [(name, Photo(image)) for name, image in (("0.png", pixels), ("1.png", larger))]
    options = RegisterOptions([Path("0.png")], [], camera=camera)
    registrar = SimpleNamespace(pipeline=Pipeline())
    first, second = (image for _, image, _, _ in following._poses(options, registrar, frames))
    again = torch.nn.functional.avg_pool2d(second[None], 2)[0]
    assert_close(again[:, 5:-5, 5:-5], first[:, 5:-5, 5:-5], atol=0.01, rtol=0.0)
    assert [call.args[1].size for call in remove.call_args_list] == [(60, 80)] * 2


@pytest.mark.slow
def test_follow_takes_the_exif_data_unasked_and_else_estimates_the_camera(
    frames, follow, tmp_path, capsys
):
    assert follow(camera=(), out="exif") == 0
    assert "camera: from the file's EXIF" in capsys.readouterr().out
    check_poses(tmp_path / "exif", frames, 4.0, 0.1)
    assert follow(source="turn.avi", camera=(), out="none") == 0
    assert "camera: focal length estimated" in capsys.readouterr().out
    rows = check_poses(tmp_path / "none", frames, 8.0, 0.5)
    zooms = [
        float(row["tz"]) / float(T[2, 3]) for row, (_, _, T) in zip(rows, frames[1], strict=False)
    ]
    assert max(zooms) < 1.05 * min(zooms), "one camera for all frames"
    assert follow("--mesh-is", "similar", camera=(), out="other") == 2
    assert "needs the camera with --mesh-is similar" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("confidence", "verdict"), slow_after(1, [(None, "reliable"), (0.2, "no match")])
)
def test_follow_starts_from_a_known_pose_and_its_confidence(
    frames, follow, tmp_path, monkeypatch, confidence, verdict
):
    """No registration confirms a doubtful one here."""
    pose = json.loads((frames[0] / "start.json").read_text())
    (tmp_path / "start.json").write_text(json.dumps(pose | {"confidence": confidence}))
    refined = Follower._refined

    def unconfirmed(self, item, starts):
        usual = self._reliable
        self._reliable = 2.0
        result = refined(self, item, starts)
        self._reliable = usual
        return result

    monkeypatch.setattr(Follower, "_refined", unconfirmed)
    assert follow("--start", tmp_path / "start.json", box=False, out="out") == 0
    assert check_poses(tmp_path / "out", frames)[0]["verdict"] == verdict


def test_follow_refines_the_start(frames, follow, tmp_path):
    """By 15 degrees about an axis of the object."""
    T = frames[1][0][2].clone()
    T[:3, :3] @= rotation_from_axis_angle(double([0.0, 0.0, math.radians(15.0)]))
    np.savetxt(tmp_path / "start.txt", T.numpy())
    start = ["--start", tmp_path / "start.txt"]
    assert follow(*start, source="turn.avi", box=False, out="out") == 0
    check_poses(tmp_path / "out", frames)


@pytest.mark.parametrize(("confidence", "starts"), [(0.19, 0), (0.21, 1), (None, 1)])
def test_a_start_that_is_no_match_is_not_followed(monkeypatch, confidence, starts):
    """Pipelines without calibration do not tell."""
    found = replace(registration(), probabilities=() if confidence is None else (confidence,))
    monkeypatch.setattr(following, "refine", lambda *_, **__: [found])
    follow = Mock()
    assert following._started(follow, torch.zeros(3, 4, 4), PoseRecord(np.eye(4))) is found
    assert follow.start.call_count == starts


def test_without_calibration_followed_poses_have_no_confidence(follow, tmp_path, monkeypatch):
    monkeypatch.setattr(following, "is_calibrated", lambda _: False)
    monkeypatch.setattr(Follower, "__call__", lambda *_: SURE)
    assert follow(source="turn.avi") == 0
    rows = table(tmp_path)
    assert [(row["verdict"], row["confidence"]) for row in rows] == [("unsure", "")] * 3


def test_a_start_without_a_camera_ends_the_run_at_once(follow, capsys):
    assert follow(source="turn.avi", camera=(), start=True) == 2
    error = capsys.readouterr().err
    assert "a start pose needs the camera; give it: --camera" in error
    assert "not sure" not in error


def test_a_box_outside_the_first_frame_ends_the_run_at_once(follow, capsys):
    box = ["--box", 1000, 1000, 1100, 1100]
    assert follow(*box, source="turn.avi", camera=(), box=False) == 2
    assert "entirely outside the" in capsys.readouterr().err


@pytest.mark.parametrize(("source", "code"), [("shots", 130), ("0", 0)])
def test_follow_keeps_the_poses_before_an_interruption(
    frames, follow, tmp_path, monkeypatch, source, code
):
    """Ctrl-C is the usual end of a live video."""
    drawn = [] if source == "shots" else ["nothing"]
    add = OverlayVideo.add

    def interrupted(*arguments):
        if drawn:
            raise KeyboardInterrupt
        drawn.append(add(*arguments))

    camera = cv2.VideoCapture(str(frames[0] / "turn.avi"))
    first = camera.read()

    def read():  # a scene at rest: live frames are dropped on a busy machine
        time.sleep(0.01)
        return first

    if source == "0":
        monkeypatch.setattr(cv2, "VideoCapture", lambda _: Mock(wraps=camera, read=read))
    monkeypatch.setattr(OverlayVideo, "add", interrupted)
    monkeypatch.setattr(Follower, "__call__", lambda *_: SURE)
    assert follow(source=source) == code
    verdicts = [row["verdict"] for row in table(tmp_path)]
    if source == "0":
        assert verdicts == ["reliable"]
        assert not (tmp_path / "overlay.mp4").exists()
    else:
        assert verdicts == ["reliable", "reliable"]
        assert [image.shape for _, image in Video(tmp_path / "overlay.mp4")] == [(3, 180, 240)]


def test_follow_keeps_no_pose_in_memory():
    """A live video may last for days."""
    tally = Tally()
    for number in range(1000):
        tally.add({"verdict": "reliable", "rotation": [number]}, 0.5)
    assert len(pickle.dumps(tally)) < 300
    assert str(tally).startswith(
        "1000 frames: 1000 reliable, 0 unsure, 0 no match, 0 lost, 0 failed, 2.0 frames per"
    )


def test_follow_and_lists_do_not_overwrite_each_other(follow, tmp_path, capsys):
    (tmp_path / "results.csv").write_text("of others")
    assert follow() == 2
    assert "results.csv: not written by this command" in capsys.readouterr().err
    assert (tmp_path / "results.csv").read_text() == "of others"


def test_an_error_names_the_frame(frames, follow, tmp_path, capsys, monkeypatch):
    failed = FailedRegistration(InvalidInputError("too small").of_image(0))
    monkeypatch.setattr(Follower, "__call__", lambda *_: failed)
    assert follow() == 2
    names = [str(frames[0] / "shots" / f"{k}.png") for k in range(3)]
    assert [row["message"] for row in table(tmp_path)][:3] == [f"{n}: too small" for n in names]
    assert f"the first: {names[0]}: too small" in capsys.readouterr().err


def test_the_message_of_a_tally_is_that_of_the_first_frame():
    tally = Tally()
    for message, counted in (("first", "1 frame: "), ("second", "2 frames: ")):
        tally.add({"verdict": "failed", "message": message}, 0.0)  # as a coarse clock has it
        assert str(tally).startswith(counted)
    assert (tally.first_message, tally.frames) == ("first", 2)
    assert str(tally) == "2 frames: 0 reliable, 0 unsure, 0 no match, 0 lost, 2 failed"
