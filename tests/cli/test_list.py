"""``curvireg register`` of lists, of photographs that are named in other ways, and of several
meshes."""

import json
import sys
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch import ViewBank
from curvireg_torch.errors import InvalidInputError
from curvireg_torch.geometry import rotation_error
from curvireg_torch.jobs import photograph
from curvireg_torch.jobs.lists import find_photographs, list_photographs, read_list
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.pipeline import PRESETS
from tests._support import scene, truck_bank, write_video
from tests._support.exif import exif
from tests._support.lists import CAMERA, RESULTS, box_of, check_pose, lines, table, written
from tests._support.new_process import run_python
from tests._support.tables import text_table

HEADER = "photo,x0,y0,x1,y1"
EMPTY = [""] * 4


@pytest.fixture
def register_list(folder, register):
    """Write a list and register it to the bank of the truck."""

    def run(name, header, *rows, mesh="truck.safetensors", words=(), out="out"):
        path = written(folder / name, header, *rows)
        return register("--list", path, *([folder / mesh] if mesh else []), *words, out=out)

    return run


def test_instances_are_those_of_each_row_without_a_box(register_list, monkeypatch):
    detect = Mock(side_effect=InvalidInputError("asked"))
    monkeypatch.setattr(photograph, "detect_prepared", detect)
    register_list("all.csv", HEADER, ["photos/2.png", *EMPTY], words=["--instances", "2"])
    assert detect.call_args.kwargs == {"instances": 2}


ROWS = [
    # note, photo, box, camera; message, or the seed of the scene
    (['a "quoted", note', "photos/0.png", *box_of(0), *CAMERA], 0),
    (["é\nü", "photos/1.png", *box_of(1), *EMPTY], 1),
    (["missing", "photos/none.png", *EMPTY, *EMPTY], "no such file"),
    (["no picture", "text.jpg", *EMPTY, *EMPTY], "text.jpg"),
    (["outside", "photos/0.png", "900", "1", "950", "9", *EMPTY], "entirely outside"),
    (["NaN box", "photos/0.png", "nan", "1", "95", "9", *EMPTY], "finite"),
    (["no number", "photos/0.png", "1", "1", "9o", "9", *EMPTY], "x1: expected a number, got '9o'"),
    (["part of a box", "photos/0.png", "1", "1", "", "9", *EMPTY], "nothing for x1"),
    (
        ["part of a camera", "photos/0.png", *box_of(0), "260", "", "119.5", "89.5"],
        "nothing for fy",
    ),
    (["NaN camera", "photos/0.png", *box_of(0), "260", "260", "nan", "89.5"], "finite"),
    (["one colour", "flat.png", *EMPTY, *EMPTY], "one colour"),
    (["short", "photos/0.png"], "2 cells"),
    (["detected", "photos/2.png", *EMPTY, *EMPTY], None),
    (["last", " photos/2.png ", *box_of(2), *CAMERA], 2),
]


def test_list_reports_every_row_in_order(register_list, tmp_path, capsys):
    """Columns come in any order and others are passed through; an unusable row does not affect the
    others."""
    header = "note,photo,x0,y0,x1,y1,fx,fy,cx,cy"
    names = header.split(",")
    assert register_list("all.csv", header, *(cells for cells, _ in ROWS)) == 0
    out = tmp_path / "out"
    assert (out / "results.csv").read_text().splitlines()[0].split(",") == [*names, *RESULTS]
    rows = table(out)
    documents = lines(out)
    for number, ((cells, expected), row, document) in enumerate(
        zip(ROWS, rows, documents, strict=True), start=1
    ):
        assert [row[name] for name in names][: len(cells)] == cells
        assert document["row"] == number
        for name in ("verdict", "message"):
            assert document[name] == row[name]
        if isinstance(expected, str):
            (message,) = row["message"].splitlines()
            assert expected in message
            cells = [row[name] for name in ("verdict", *RESULTS[2:])]
            assert cells == ["failed", "", "false", *[""] * 13]
        else:
            assert (row["verdict"], row["message"]) == ("unsure", "")
            assert (row["confidence"], row["reliable"]) == ("", "false"), "not calibrated"
            R = torch.tensor(document["rotation"], dtype=torch.float64)
            assert expected is None or float(rotation_error(R, scene(expected)[2][:3, :3])) < 15
            assert [[float(row[f"r{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)] == R.tolist()
    check_pose(rows[0], scene(0)[2], 15.0, 0.1)
    assert "" not in [rows[1][name] for name in ("tx", "ty", "tz")], "of an estimated camera"
    assert (documents[0]["camera_source"], documents[1]["camera_source"]) == ("given", "estimated")
    assert documents[0]["columns"] == dict(zip(names, ROWS[0][0], strict=True))
    counts = "14 photographs: 0 reliable, 4 unsure, 0 no match, 0 lost, 10 failed"
    assert capsys.readouterr().out.splitlines()[-1] == f"{counts}; see {out}/results.csv"


@pytest.mark.slow
def test_list_opens_each_mesh_once(folder, register_list, tmp_path, monkeypatch):
    """A mesh that is missing or broken fails only its rows."""
    load = Mock(wraps=ViewBank.load)
    monkeypatch.setattr(ViewBank, "load", load)
    content = (folder / "truck.safetensors").read_bytes()
    other = folder / "other.safetensors"
    cut = folder / "cut.safetensors"
    other.write_bytes(content)
    cut.write_bytes(content[:1000])
    meshes = ["", other, "", "none.ply", cut, other, cut]
    rows = [[mesh, "photos/0.png", *box_of(0)] for mesh in meshes]
    assert register_list("meshes.csv", f"mesh,{HEADER}", *rows) == 0
    found = table(tmp_path / "out")
    usable = ("", other)
    verdicts = ["unsure" if mesh in usable else "failed" for mesh in meshes]
    assert [row["verdict"] for row in found] == verdicts
    assert "none.ply" in found[3]["message"]
    assert "build" in found[4]["message"]
    assert [call.args[0] for call in load.mock_calls] == [folder / "truck.safetensors", other, cut]
    assert register_list("meshes.csv", f"mesh,{HEADER}", *rows, mesh=None, out="no mesh") == 0
    found = table(tmp_path / "no mesh")
    verdicts = ["unsure" if mesh == other else "failed" for mesh in meshes]
    assert [row["verdict"] for row in found] == verdicts
    assert "no MESH" in found[0]["message"]


def test_list_without_any_result_ends_with_code_2(register_list, refused, tmp_path):
    refused(
        register_list("none.csv", HEADER, ["none.png", *EMPTY]), "no photograph could be registered"
    )
    assert "no such file" in table(tmp_path / "out")[0]["message"]


LIMITED = text_table("""
azimuth   | 140 220  | {"azimuth": [140, 220]}
elevation | 0 60     | {"elevation": [0, 60]}
side      | front    | {"azimuth": [315, 45]}
near      | 180 20   | {"viewpoint": [180, 20, 0], "within": 45}
          |          | {}
distance  | 1 2      | {"distance": [1, 2]}
distance  | "1"      | distance: expected
azimuth   | "140"    | azimuth: expected LOW HIGH
azimuth   | from 140 | azimuth: expected LOW HIGH, finite numbers, got 'from 140'
side      | top      | side
near      | 1 2 3 4  | near: expected AZIMUTH
within    | 1 2      | within: expected DEG
front     | z        | front: expected another axis
""")
"""Column, cell, and a part of the message or the prior in the result beside the elevation."""


def test_list_has_limits_of_each_row(register_list, tmp_path):
    """An empty cell leaves the option of the command line; a wrong one fails its row."""
    names = ["azimuth", "elevation", "side", "near", "within", "distance", "front"]
    rows = [[cell if name == column else "" for name in names] for column, cell, _ in LIMITED]
    words = ["--elevation", "-10", "80", "--no-refine"]
    photo = ["photos/0.png", *box_of(0)]
    header = f"{HEADER},{','.join(names)}"
    assert register_list("limited.csv", header, *([*photo, *row] for row in rows), words=words) == 0
    for (*_, expected), row in zip(LIMITED, lines(tmp_path / "out"), strict=True):
        if isinstance(expected, str):
            assert row["verdict"] == "failed"
            assert expected in row["message"]
        else:
            assert row["verdict"] != "failed"
            found = {k: v for k, v in row["prior"].items() if k != "contradiction"}
            assert found == {"elevation": [-10, 80]} | expected


def test_a_photograph_that_is_named_twice_is_one(folder, register, tmp_path, capsys):
    photo = tmp_path / "photo.png"
    photo.write_bytes(b"no photograph")
    register(photo, photo, folder / "truck.safetensors", "--box", *box_of(0))
    printed = capsys.readouterr()
    assert "1 photograph: 0 reliable, 0 unsure, 0 no match, 0 lost, 1 failed" in printed.out
    assert "used for all" not in printed.err


def test_register_files_folders_and_patterns(folder, register, document, refused, tmp_path, capsys):
    photos = folder / "photos"
    bank = (folder / "truck.safetensors", "--box", *box_of(0), "--camera", *CAMERA)
    assert register(photos / "2.png", photos, photos / "[01].png", folder / "none.png", *bank) == 0
    rows = table(tmp_path / "out")
    assert list(rows[0])[:9] == ["photo", "x0", "y0", "x1", "y1", "fx", "fy", "cx", "cy"]
    inputs = lines(tmp_path / "out")[1]["inputs"]
    assert inputs["box"] == [float(v) for v in box_of(0)]
    assert inputs["camera"] == [float(v) for v in CAMERA]
    files = [*(photos / name for name in ("2.png", "0.png", "1.png")), folder / "none.png"]
    assert [row["photo"] for row in rows] == [*map(str, files)]
    assert [row["verdict"] for row in rows] == ["unsure"] * 3 + ["failed"]
    assert [float(v) for v in [*rows[0].values()][1:9]] == [*inputs["box"], *inputs["camera"]]
    (said,) = capsys.readouterr().err.splitlines()
    assert "--box and --camera: used for all 4 photographs" in said
    assert register(photos / "2.png", *bank, out="one") == 0
    alone = document("one")
    listed = lines(tmp_path / "out")[0]
    for key in ("rotation", "score", "confidence", "verdict", "pipeline"):
        assert alone[key] == listed[key], key
    assert alone["no_match_probability"] == listed["none"]
    for one, other in zip(alone["hypotheses"], listed["top"], strict=True):
        # beside other photographs it is rounded otherwise
        assert np.abs(np.subtract(one["rotation"], other["rotation"])).max() < 1e-3
    assert not (tmp_path / "one" / "results.csv").exists()
    refused(register(folder / "nothing*.png", *bank), "nothing*.png: no photographs")
    refused(register(photos, *bank, "--textures", folder / "none"), "the folder of the textures")


def test_register_chooses_among_meshes(folder, register, document, tmp_path, capsys):
    box = folder / "box.safetensors"
    truck = folder / "truck.safetensors"
    views = {"views": truck_bank().views, "pipeline": PRESETS["classical"], "image_size": 96}
    ViewBank.build(trimesh.creation.box((1.0, 0.2, 0.1)), **views, progress=False).save(box)
    meshes = ["--mesh", box, "--mesh", truck]
    assert register(folder / "photos" / "0.png", *meshes, "--box", *box_of(0), out="one") == 0
    assert document("one")["mesh"] == str(truck)
    assert f"mesh: {truck}" in capsys.readouterr().out
    path = written(folder / "which.csv", HEADER, ["photos/0.png", *box_of(0)], ["text.jpg", *EMPTY])
    assert register("--list", path, *meshes) == 0
    found = table(tmp_path / "out")
    assert list(found[0])[-1] == "found_mesh"
    assert [row["found_mesh"] for row in found] == [str(truck), ""]
    first_row = document("one")["rotation"][0]
    assert [found[0][f"r1{j}"] for j in (1, 2, 3)] == [str(v) for v in first_row]


def test_register_every_nth_frame_of_a_video(folder, register, refused, tmp_path):
    """Which is decoded as it is needed: no frame is written."""
    seeds = (0, 1, 2, 2, 1)
    video = write_video(folder / "turn.avi", [scene(seed)[0] for seed in seeds])
    bank = folder / "truck.safetensors"
    (folder / "none.mp4").write_bytes(b"not a video")
    refused(register(folder / "none.mp4", bank, out="none"), "none.mp4: not a video")
    assert register(video, bank, "--every", "2", "--box", *box_of(0)) == 0
    rows = table(tmp_path / "out")
    assert [row["photo"] for row in rows] == [f"{video}:00000{n}" for n in (0, 2, 4)]
    assert [row["verdict"] for row in rows] == ["unsure"] * 3
    assert not list((tmp_path / "out").rglob("*.png")), "no frame is written"
    entries = list_photographs(RegisterOptions((video,)), every=2)
    for entry, seed in zip(entries, seeds[::2], strict=True):
        assert (entry.read().image - 255 * scene(seed)[0]).abs().mean() < 6  # MJPG is lossy


def test_boxes_of_a_detector_are_found_by_the_name_of_each_photograph(folder, register, tmp_path):
    x0, y0, x1, y1 = map(float, box_of(0))
    boxes = [
        {"image_id": str(seed), "bbox": [x0, y0, x1 - x0, y1 - y0], "score": 0.5} for seed in (0, 1)
    ]
    (tmp_path / "boxes.json").write_text(json.dumps(boxes))
    words = "--boxes", tmp_path / "boxes.json", "--no-refine"
    assert register(folder / "photos", folder / "truck.safetensors", *words, out="boxes") == 0
    rows = lines(tmp_path / "boxes")
    assert [row["verdict"] for row in rows] == ["unsure", "unsure", "failed"]
    assert rows[0]["inputs"]["box"] == pytest.approx(
        [x0 - 0.5, y0 - 0.5, x1 - 0.5, y1 - 0.5], abs=1e-3
    )
    assert "no box in" in rows[2]["message"]


def test_paths_of_windows_and_boxes_in_fractions_in_lists(folder):
    x0, y0, x1, y1 = map(float, box_of(0))
    fractions = [(x0 + 0.5) / 240, (y0 + 0.5) / 180, (x1 + 0.5) / 240, (y1 + 0.5) / 180]
    path = written(
        folder / "windows.csv", HEADER, ["photos\\0.png", *fractions], ["photos\\9.png", *fractions]
    )
    options = RegisterOptions(meshes=(folder / "truck.ply",), box_format="fractions")
    good, missing = read_list(path, options)
    assert good.photo == folder / "photos" / "0.png"
    assert good.name == "photos\\0.png"
    assert good.box == pytest.approx([x0, y0, x1, y1])
    assert "no such file" in missing.error


def test_photographs_of_telephones_in_folders_and_alone(folder, register, tmp_path, monkeypatch):
    encoder = pytest.importorskip("pillow_heif")
    pytest.importorskip("pi_heif")
    pixels = np.ascontiguousarray(cv2.imread(str(folder / "photos" / "0.png"))[..., ::-1])
    shots = tmp_path / "shots"
    shots.mkdir()
    heic = encoder.from_bytes("RGB", pixels.shape[1::-1], pixels.tobytes())
    heic.save(shots / "IMG_2.HEIC", quality=95, exif=exif(1, 38))
    cv2.imwrite(str(shots / "IMG_1.JPG"), pixels[..., ::-1])
    assert register(shots, folder / "truck.safetensors", "--box", *box_of(0)) == 0
    assert [(row["inputs"]["photo"][-10:], row["verdict"]) for row in lines(tmp_path / "out")] == [
        ("/IMG_1.JPG", "unsure"),
        ("IMG_2.HEIC", "unsure"),
    ]
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    assert len(find_photographs(shots)) == 2, "counted where there is no decoder"


FIRST_WORD = """
import sys
from curvireg_torch.cli import main, register

def stop():
    sys.exit(7)

register.load_libraries = stop
main(sys.argv[1:])
"""


def test_a_list_says_its_first_word_before_libraries_are_loaded(folder, tmp_path):
    """Reading a long list takes seconds, too."""
    path = written(tmp_path / "list.csv", "photo,x0,y0,x1,y1", ["a.png", *box_of(0)])
    words = ["register", "--list", path, folder / "truck.safetensors", "--out", tmp_path / "out"]
    for quiet, said in ((["--quiet"], ""), ([], f"{path}: reading\n")):
        done = run_python(FIRST_WORD, *words, *quiet)
        assert (done.returncode, done.stderr) == (7, said)
