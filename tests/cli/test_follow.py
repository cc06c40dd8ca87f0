"""``curvireg follow``: poses and a video."""

import csv
import re

import cv2
import pytest
import torch

from curvireg_torch.cli import main
from curvireg_torch.data import Video
from curvireg_torch.geometry import rotation_error
from curvireg_torch.registration import Follower
from tests._support.lists import CAMERA
from tests._support.scenes import learned_registrar, sequence


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("follow")
    learned_registrar().bank.save(folder / "truck.safetensors")
    (folder / "shots").mkdir()
    scenes = sequence(3)
    for k, (image, _, _) in enumerate(scenes):
        pixels = (image.permute(1, 2, 0).flip(-1) * 255).round().byte().numpy()
        cv2.imwrite(str(folder / "shots" / f"{k}.png"), pixels)
    (folder / "shots" / "3.png").write_bytes(b"no photograph")
    return folder, scenes


def run(folder, *options):
    return main(["follow", str(folder / "shots"), str(folder / "truck.safetensors"), "--quiet", *map(str, options)])


def test_follow_writes_a_pose_for_each_frame(frames, tmp_path, capsys):
    folder, scenes = frames
    box = scenes[0][1].tolist()
    assert run(folder, "--camera", *CAMERA, "--box", *box, "--out", tmp_path) == 0
    closing = capsys.readouterr().out
    assert "4 frames: 3 of 4 believed, 0 unsure, 0 lost, 1 failed" in closing
    rate = re.search(r", ([\d.]+) frames per second; see", closing)
    assert rate is not None
    assert float(rate[1]) > 0.0
    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok", "ok", "ok", "failed"]
    for row, (_, _, T) in zip(rows, scenes, strict=False):
        R = torch.tensor([float(row[f"r{i}{j}"]) for i in (1, 2, 3) for j in (1, 2, 3)], dtype=torch.float64)
        t = torch.tensor([float(row[name]) for name in ("tx", "ty", "tz")], dtype=torch.float64)
        assert float(rotation_error(R.view(3, 3), T[:3, :3])) < 4.0
        assert float((t - T[:3, 3]).norm() / T[:3, 3].norm()) < 0.04
        assert 0.0 <= float(row["confidence"]) <= 1.0
    assert (rows[3]["r11"], rows[3]["confidence"], rows[0]["message"]) == ("", "", "")
    assert "3.png" in rows[3]["message"]
    pictures = [image.int() for _, image in Video(tmp_path / "overlay.mp4")]
    assert [tuple(image.shape) for image in pictures] == [(3, 180, 240)] * 4
    assert pictures[3][:, 40:].max() < 30  # the unreadable frame is black
    photograph = (scenes[2][0] * 255).int()
    assert 2 < (pictures[2] - photograph).abs().float().mean() < 30  # contours and codec


def test_follow_reads_a_video_and_keeps_its_rate(frames, tmp_path):
    folder, scenes = frames
    writer = cv2.VideoWriter(str(tmp_path / "turn.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (240, 180))
    for k in range(3):
        writer.write(cv2.imread(str(folder / "shots" / f"{k}.png")))
    writer.release()
    options = ("--quiet", "--camera", *CAMERA, "--box", *scenes[0][1].tolist(), "--out", tmp_path / "out")
    assert main(["follow", str(tmp_path / "turn.avi"), str(folder / "truck.safetensors"), *map(str, options)]) == 0
    with (tmp_path / "out" / "results.csv").open() as file:
        assert [(row["photo"], row["status"]) for row in csv.DictReader(file)] == [
            (f"turn-00000{k}", "ok") for k in range(3)
        ]
    assert Video(tmp_path / "out" / "overlay.mp4").fps == 25.0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["overlay.mp4", "results.csv"]


def test_follow_needs_a_camera(frames, tmp_path, capsys):
    assert run(frames[0], "--out", tmp_path) == 2
    assert "--camera" in capsys.readouterr().err


def test_follow_refuses_a_missing_video(frames, tmp_path, capsys):
    mesh = frames[0] / "truck.safetensors"
    assert main(["follow", "nowhere.mp4", str(mesh), "--camera", *CAMERA, "--out", str(tmp_path)]) == 2
    assert "nowhere.mp4: no such folder or video" in capsys.readouterr().err


def test_follow_keeps_the_poses_before_an_interruption(frames, tmp_path, monkeypatch):
    call, seen = Follower.__call__, []

    def interrupted(self, *args):
        seen.append(args)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return call(self, *args)

    monkeypatch.setattr(Follower, "__call__", interrupted)
    folder, scenes = frames
    assert run(folder, "--camera", *CAMERA, "--box", *scenes[0][1].tolist(), "--out", tmp_path) == 130
    with (tmp_path / "results.csv").open() as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["ok"]
    assert len(list(Video(tmp_path / "overlay.mp4"))) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["overlay.mp4", "results.csv"]
