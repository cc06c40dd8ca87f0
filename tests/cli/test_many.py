"""``curvireg register`` of several photographs that are named in other ways than a CSV file, and of several meshes."""

import json

import cv2
import numpy as np
import pytest
import trimesh

from curvireg_torch import ViewBank
from curvireg_torch.pipeline import PRESETS
from tests._support.lists import CAMERA, box_of, lines, table, written
from tests._support.scenes import truck_bank


@pytest.fixture
def document(tmp_path):
    return lambda out: json.loads((tmp_path / out / "result.json").read_text())


def test_register_files_folders_and_patterns(folder, register, document, refused, tmp_path, capsys):
    photos, bank = folder / "photos", folder / "truck.safetensors"
    assert register(photos / "2.png", photos, photos / "[01].png", folder / "none.png", bank) == 0
    rows = table(tmp_path / "out")
    assert list(rows[0])[:9] == ["photo", "x0", "y0", "x1", "y1", "fx", "fy", "cx", "cy"]
    names = ["2.png", "0.png", "1.png", "2.png", "0.png", "1.png"]
    assert [row["photo"] for row in rows] == [*(str(photos / name) for name in names), str(folder / "none.png")]
    assert [row["status"] for row in rows] == ["ok"] * 6 + ["failed"]
    assert capsys.readouterr().err == ""
    assert register(photos / "2.png", bank, out="one") == 0
    alone, listed = document("one"), lines(tmp_path / "out")[0]
    for key in ("rotation", "score", "confidence", "top", "pipeline"):
        assert alone[key] == listed[key], key
    assert not (tmp_path / "one" / "results.csv").exists()
    refused(register(folder / "nothing*.png", bank), "nothing*.png: no photographs")


def test_register_uses_box_and_camera_for_all_photographs(folder, register, tmp_path, capsys):
    photos = [folder / "photos" / "0.png", folder / "photos" / "1.png"]
    assert register(*photos, folder / "truck.safetensors", "--box", *box_of(0), "--camera", *CAMERA) == 0
    assert "--box and --camera: used for all 2 photographs" in capsys.readouterr().err
    for line in lines(tmp_path / "out"):
        assert line["inputs"]["box"] == [float(v) for v in box_of(0)]
        assert len(line["translation"]) == 3


def test_register_chooses_among_meshes(folder, register, document, tmp_path, capsys):
    box, truck = folder / "box.safetensors", folder / "truck.safetensors"
    views = {"views": truck_bank().views, "pipeline": PRESETS["classical"], "image_size": 96}
    ViewBank.build(trimesh.creation.box((1.0, 0.2, 0.1)), **views, progress=False).save(box)
    meshes = ["--mesh", box, "--mesh", truck]
    assert register(folder / "photos" / "0.png", *meshes, "--box", *box_of(0), out="one") == 0
    assert document("one")["mesh"] == str(truck)
    assert f"mesh: {truck}" in capsys.readouterr().out
    rows = ["photos/0.png", *box_of(0)], ["text.jpg", *[""] * 4]
    path = written(folder / "which.csv", "photo,x0,y0,x1,y1", *rows)
    assert register("--list", path, *meshes) == 0
    found = table(tmp_path / "out")
    assert list(found[0])[-1] == "found_mesh"
    assert [row["found_mesh"] for row in found] == [str(truck), ""]
    assert [found[0][f"r1{j}"] for j in (1, 2, 3)] == [str(v) for v in document("one")["rotation"][0]]


def test_register_every_nth_frame_of_a_video(folder, register, refused, tmp_path):
    video = cv2.VideoWriter(str(folder / "turn.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (240, 180))
    frames = [cv2.imread(str(folder / "photos" / f"{seed}.png")) for seed in range(3)]
    for seed in (0, 1, 2, 2, 1):
        video.write(frames[seed])
    video.release()
    bank = folder / "truck.safetensors"
    assert register(folder / "turn.avi", bank, "--every", "2") == 0
    rows = table(tmp_path / "out")
    assert [row["photo"].rpartition("/")[2] for row in rows] == [f"turn-00000{n}.png" for n in (0, 2, 4)]
    for row, expected in zip(rows, (frames[0], frames[2], frames[1]), strict=True):
        assert row["status"] == "ok"
        assert np.abs(cv2.imread(row["photo"]).astype(int) - expected).mean() < 6  # MJPG is lossy
    (folder / "none.mp4").write_bytes(b"not a video")
    refused(register(folder / "none.mp4", bank, out="none"), "none.mp4: not a video")
