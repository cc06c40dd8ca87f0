"""``curvireg register`` of photographs named in other ways than a CSV file, and of several meshes."""

import json

import cv2
import numpy as np
import pytest
import trimesh

from curvireg_torch import ViewBank
from curvireg_torch.cli import main
from curvireg_torch.evaluation.lists import read_list
from curvireg_torch.pipeline import PRESETS
from tests._support.lists import CAMERA, box_of, lines, table, write_files, written
from tests._support.miniature import write_bop
from tests._support.scenes import truck_bank


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("many"))
    box = trimesh.creation.box((1.0, 0.2, 0.1))
    views = truck_bank().views
    ViewBank.build(box, views, pipeline=PRESETS["classical"], image_size=96, progress=False).save(
        folder / "box.safetensors"
    )
    return folder


def register(folder, *words, out="out"):
    return main(["register", *map(str, words), "--out", str(folder / out), "--quiet", "--no-refine"])


def result(folder, name="out"):
    return json.loads((folder / name / "result.json").read_text())


def test_files_folders_and_patterns(folder, capsys):
    photos, bank = folder / "photos", folder / "truck.safetensors"
    assert register(folder, photos / "2.png", photos, photos / "[01].png", folder / "none.png", bank, out="a") == 0
    found = table(folder / "a")
    assert list(found[0])[:9] == ["photo", "x0", "y0", "x1", "y1", "fx", "fy", "cx", "cy"]
    names = ["2.png", "0.png", "1.png", "2.png", "0.png", "1.png"]
    assert [row["photo"] for row in found] == [*(str(photos / name) for name in names), str(folder / "none.png")]
    assert [row["status"] for row in found] == ["ok"] * 6 + ["failed"]
    assert capsys.readouterr().err == ""
    # The whole image is that of the photograph alone.
    assert register(folder, photos / "2.png", bank, out="b") == 0
    assert result(folder, "b")["rotation"] == lines(folder / "a")[0]["rotation"]
    assert not (folder / "b" / "results.csv").exists()
    assert register(folder, folder / "nothing*.png", bank) == 2
    assert "nothing*.png: no photographs" in capsys.readouterr().err


def test_a_box_is_of_all_and_that_is_said(folder, capsys):
    words = ["--box", *box_of(0), "--camera", *CAMERA]
    photos = [folder / "photos" / "0.png", folder / "photos" / "1.png"]
    assert register(folder, *photos, folder / "truck.safetensors", *words, out="c") == 0
    assert "--box and --camera: used for all 2 photographs" in capsys.readouterr().err
    for line in lines(folder / "c"):
        assert line["inputs"]["box"] == [float(v) for v in box_of(0)]
        assert len(line["translation"]) == 3


def test_which_of_several_meshes(folder, capsys):
    meshes = ["--mesh", folder / "box.safetensors", "--mesh", folder / "truck.safetensors"]
    assert register(folder, folder / "photos" / "0.png", *meshes, "--box", *box_of(0), out="d") == 0
    truck = str(folder / "truck.safetensors")
    assert result(folder, "d")["mesh"] == truck
    assert {pose["mesh"] for pose in result(folder, "d")["top"]} <= {truck, str(folder / "box.safetensors")}
    assert f"mesh: {truck}" in capsys.readouterr().out
    path = written(folder / "which.csv", "photo,x0,y0,x1,y1", *(["photos/0.png", *box_of(0)], ["text.jpg", *[""] * 4]))
    assert register(folder, "--list", path, *meshes, out="e") == 0
    found = table(folder / "e")
    assert list(found[0])[-1] == "found_mesh"
    assert [row["found_mesh"] for row in found] == [truck, ""]
    assert [found[0][f"r1{j}"] for j in (1, 2, 3)] == [str(v) for v in result(folder, "d")["rotation"][0]]


def test_json_lists(folder):
    box = [float(v) for v in box_of(1)]
    content = [
        {
            "photo": "photos/1.png",
            "box": box,
            "camera": [260, 260.0, 119.5, 89.5],
            "mesh": "truck.safetensors",
            "id": 7,
        },
        {"photo": "photos/1.png", "box": [1, 2, 3]},
        {"photo": "photos/0.png", "note": {"deep": None}},
        {"box": box},
    ]
    (folder / "list.json").write_text(json.dumps(content))
    assert register(folder, "--list", folder / "list.json", folder / "truck.safetensors", out="f") == 0
    found = table(folder / "f")
    assert [row["status"] for row in found] == ["ok", "failed", "ok", "failed"]
    assert "x0" in found[1]["message"]
    assert "photo: empty" in found[3]["message"]
    assert found[0]["id"] == "7"
    assert found[0]["tx"] != "" == found[2]["tx"]
    assert lines(folder / "f")[0]["inputs"]["box"] == box


def test_coco_boxes_count_from_the_pictures_corner(tmp_path):
    content = {
        "images": [{"id": 4, "file_name": "a.jpg"}, {"id": 5, "file_name": "b.jpg"}],
        "categories": [{"id": 1, "name": "truck"}],
        "annotations": [
            {"id": 8, "image_id": 5, "category_id": 1, "bbox": [0, 10, 20, 30]},
            {"id": 9, "image_id": 4, "category_id": 2},
        ],
    }
    (tmp_path / "coco.json").write_text(json.dumps(content))
    found = read_list(tmp_path / "coco.json", [tmp_path / "truck.ply"])
    assert found.columns[5:] == ("image_id", "annotation_id", "category")
    first, second = found.entries
    assert (first.photo, first.box) == (tmp_path / "b.jpg", (-0.5, 9.5, 19.5, 39.5))
    assert first.cells[5:] == ("5", "8", "truck")
    assert "no bbox" in second.error


def test_a_scene_of_a_bop_set(tmp_path):
    from curvireg_torch.data import BOPDataset

    write_bop(tmp_path)
    dataset = BOPDataset(tmp_path)
    known = {}
    for item in (dataset.annotation(i) for i in range(len(dataset))):
        known.setdefault(item["scene_id"], []).append(item)
    scene_id, items = next(iter(known.items()))
    scene = tmp_path / "test" / f"{scene_id:06d}"
    found = read_list(scene)
    usable = {
        (str(entry.photo), entry.box, entry.camera, entry.meshes[0].name) for entry in found.entries if not entry.error
    }
    assert items
    for item in items:
        K = item["camera_matrix"]
        camera = tuple(float(v) for v in (K[0][0], K[1][1], K[0][2], K[1][2]))
        mesh = item["model_path"].rpartition("/")[2]
        assert (item["image_path"], tuple(item["box"].tolist()), camera, mesh) in usable
    assert any("no bbox_obj" in entry.error for entry in found.entries)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[1, 2]", ["list of objects"]),
        ("{", ["not JSON"]),
        ("[" * 100_000, ["not JSON"]),
        ("[]", ["no photographs"]),
        ('{"images": [], "annotations": [{"image_id": 3, "bbox": [1, 2, 3, 4]}]}', ["COCO", "3"]),
        ('{"images": 3, "annotations": []}', ["COCO"]),
    ],
)
def test_json_that_cannot_be_used(tmp_path, capsys, content, words):
    (tmp_path / "list.json").write_text(content)
    assert register(tmp_path, "--list", tmp_path / "list.json", "truck.ply") == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    for word in ["list.json", *words]:
        assert word in error


def test_a_folder_that_is_no_scene(tmp_path, capsys):
    assert register(tmp_path, "--list", tmp_path, "truck.ply") == 2
    assert "scene_camera.json" in capsys.readouterr().err
    for name in ("scene_camera", "scene_gt", "scene_gt_info"):
        (tmp_path / f"{name}.json").write_text('{"1": [[]]}')
    assert register(tmp_path, "--list", tmp_path, "truck.ply") == 2
    assert "not a scene" in capsys.readouterr().err


def test_every_nth_frame_of_a_video(folder, capsys):
    video = cv2.VideoWriter(str(folder / "turn.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (240, 180))
    frames = [cv2.imread(str(folder / "photos" / f"{seed}.png")) for seed in (0, 1, 2)]
    for frame in (frames[0], frames[1], frames[2], frames[2], frames[1]):
        video.write(frame)
    video.release()
    assert register(folder, folder / "turn.avi", folder / "truck.safetensors", "--every", "2", out="video") == 0
    found = table(folder / "video")
    assert [row["photo"].rpartition("/")[2] for row in found] == [f"turn-00000{n}.png" for n in (0, 2, 4)]
    for row, wanted in zip(found, (frames[0], frames[2], frames[1]), strict=True):
        assert row["status"] == "ok"
        assert np.abs(cv2.imread(row["photo"]).astype(int) - wanted).mean() < 6  # MJPG loses a little
    (folder / "none.mp4").write_bytes(b"not a video")
    assert register(folder, folder / "none.mp4", folder / "truck.safetensors", out="none") == 2
    assert "none.mp4: not a video" in capsys.readouterr().err
    assert register(folder, folder / "turn.avi", folder / "truck.safetensors", "--every", "0", out="none") == 2
    assert "--every" in capsys.readouterr().err
