"""``curvireg follow``: a table of poses, one row for each frame."""

import csv

import cv2
import pytest
import torch

from curvireg_torch.cli import main
from curvireg_torch.geometry import rotation_error
from curvireg_torch.registration import Follower
from tests._support.lists import CAMERA
from tests._support.scenes import truck_bank
from tests.registration.test_following import sequence


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    folder = tmp_path_factory.mktemp("follow")
    truck_bank().save(folder / "truck.safetensors")
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
    assert "4 frames: 3 ok, 0 lost, 1 failed" in capsys.readouterr().out
    with (tmp_path / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok", "ok", "ok", "failed"]
    for row, (_, _, T) in zip(rows, scenes, strict=False):
        R = torch.tensor([float(row[f"r{i}{j}"]) for i in (1, 2, 3) for j in (1, 2, 3)], dtype=torch.float64)
        t = torch.tensor([float(row[name]) for name in ("tx", "ty", "tz")], dtype=torch.float64)
        assert float(rotation_error(R.view(3, 3), T[:3, :3])) < 4.0
        assert float((t - T[:3, 3]).norm() / T[:3, 3].norm()) < 0.04
        assert 0.0 <= float(row["confidence"]) <= 1.0
    assert (rows[3]["r11"], rows[3]["confidence"]) == ("", "")


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
