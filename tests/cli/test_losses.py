"""Nothing is lost or mixed up: photographs of one name, and files that exist."""

import shutil

import cv2
import numpy as np
import pytest

from curvireg_torch.cli import main
from curvireg_torch.formats.exports.ros import FILES
from curvireg_torch.jobs.outputs import MARKER, output_folder
from tests._support.lists import CAMERA, box_of, lines, table, written
from tests._support.quick import slow_after
from tests._support.scenes import scene


def write_video(path, seeds):
    """A video of photographs of the scenes with these seeds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (240, 180))
    for seed in seeds:
        pixels = (scene(seed)[0].permute(1, 2, 0).flip(-1) * 255).round().byte().numpy()
        video.write(np.ascontiguousarray(pixels))
    video.release()
    return path


VIDEOS = [
    ("left/cam.avi", "right/cam.avi"),
    ("a.avi", "a.mkv"),
    ("x/shots/cam.avi", "y/shots/cam.avi"),
]


@pytest.mark.parametrize(("first", "second"), slow_after(1, VIDEOS))
def test_two_videos_of_one_name_keep_their_own_results(folder, register, tmp_path, first, second):
    videos = [write_video(tmp_path / name, [seed]) for seed, name in enumerate((first, second))]
    assert register(*videos, folder / "truck.safetensors", "--box", *box_of(0)) == 0
    rows = table(tmp_path / "out")
    assert [row["photo"] for row in rows] == [f"{video}:000000" for video in videos]
    together = lines(tmp_path / "out")
    for number, video in enumerate(videos):
        assert (
            register(video, folder / "truck.safetensors", "--box", *box_of(0), out=str(number)) == 0
        )
        (alone,) = lines(tmp_path / str(number))
        assert (alone["rotation"], alone["score"]) == (
            together[number]["rotation"],
            together[number]["score"],
        )
    assert together[0]["rotation"] != together[1]["rotation"]
    assert register(*videos[::-1], folder / "truck.safetensors", "--box", *box_of(0)) == 0
    assert [row["r11"] for row in table(tmp_path / "out")] == [row["r11"] for row in rows[::-1]]


def test_photographs_of_one_name_keep_their_own_results(folder, register, tmp_path):
    for side, seed in (("left", 0), ("right", 1)):
        (tmp_path / side).mkdir()
        shutil.copy(folder / "photos" / f"{seed}.png", tmp_path / side / "photo.png")
    photos = tmp_path / "left", tmp_path / "right"
    assert register(*photos, folder / "truck.safetensors", "--box", *box_of(0)) == 0
    rows = table(tmp_path / "out")
    assert [row["photo"] for row in rows] == [str(side / "photo.png") for side in photos]
    assert rows[0]["r11"] != rows[1]["r11"]


THEIRS = ("result.json", "overlay.png", "pose.glb", *FILES)
LISTS = ("results.csv", "results.jsonl", "index.html")


@pytest.mark.parametrize(
    ("name", "several"), [*((name, False) for name in THEIRS), *((name, True) for name in LISTS)]
)
def test_register_removes_no_file_of_others(
    folder, register, refused, tmp_path, monkeypatch, name, several
):
    (tmp_path / name).write_text("of others")
    (tmp_path / "predictions.csv").write_text("of others")
    monkeypatch.chdir(tmp_path)
    photos = [folder / "photos" / "0.png", *([folder / "photos" / "1.png"] if several else [])]
    code = register(
        *photos, folder / "truck.safetensors", *([] if several else ["--box", *box_of(0)]), out="."
    )
    refused(code, f"{name}: not written by this command")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(
        [name, "predictions.csv"], "of others"
    )


def test_register_overwrites_no_input(folder, register, refused, tmp_path, capsys):
    out = tmp_path / "out"
    words = [folder / "truck.safetensors", "--box", *box_of(0), "--camera", *CAMERA]
    assert register(folder / "photos" / "0.png", *words) == 0
    capsys.readouterr()
    before = {path: path.read_bytes() for path in out.iterdir()}
    start = ["--camera", *CAMERA, "--start", out / "result.json"]
    refused(
        register(folder / "photos" / "0.png", words[0], *start),
        "result.json: an input of this command",
    )
    refused(register(out / "overlay.png", *words), "overlay.png: an input of this command")
    refused(
        register(folder / "photos" / "0.png", out / "pose.glb", *words[1:]),
        "pose.glb: an input of this command",
    )
    start[-1] = f"{out / 'result.json'}:0"
    refused(register(folder / "photos" / "0.png", words[0], *start), "result.json")
    listed = written(
        out / "results.csv", "photo,x0,y0,x1,y1", [folder / "photos" / "0.png", *box_of(0)]
    )
    before[listed] = listed.read_bytes()
    refused(register("--list", listed, words[0]), "results.csv: an input of this command")
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_a_second_list_does_not_remove_the_rows_of_the_first(folder, register, refused, tmp_path):
    bank = folder / "truck.safetensors"
    rows = [[f"photos/{seed}.png", *box_of(seed)] for seed in (0, 1)]
    lists = [
        written(folder / f"{seed}.csv", "photo,x0,y0,x1,y1", row) for seed, row in enumerate(rows)
    ]
    assert register("--list", lists[0], bank) == 0
    before = (tmp_path / "out" / "results.csv").read_bytes()
    refused(
        register("--list", lists[1], bank),
        "out/index.html: holds results of",
        "0.csv, which would be lost",
    )
    refused(
        register(*(folder / "photos" / f"{seed}.png" for seed in (0, 1)), bank),
        "0.csv, which would be lost",
    )
    assert (tmp_path / "out" / "results.csv").read_bytes() == before
    written(lists[0], "photo,x0,y0,x1,y1", *rows)
    assert register("--list", lists[0], bank) == 0
    assert len(table(tmp_path / "out")) == 2, "a longer list goes on"


def test_demo_plot_and_bank_overwrite_no_file_of_others(folder, refused, tmp_path):
    for name in ("mesh.ply", "photo.png", "plot.png", "plot.svg", "bank.safetensors"):
        (tmp_path / name).write_text("of others")
    refused(
        main(["demo", "--out", str(tmp_path), "--quiet"]), "mesh.ply: not written by this command"
    )
    files = [str(folder / "photos" / "0.png"), str(folder / "truck.safetensors")]
    for name in ("plot.png", "plot.svg"):
        out = ["--out", str(tmp_path / name), "--quiet"]
        refused(main(["plot", "overlay", *files, "--box", *box_of(0), *out]), f"{name}: exists")
    mine = [
        "plot",
        "viewpoints",
        *files,
        "--box",
        *box_of(0),
        "--out",
        str(tmp_path / "mine.png"),
        "--quiet",
    ]
    assert (main(mine), main(mine)) == (0, 0)
    photo = tmp_path / "shot.png"
    shutil.copy(files[0], photo)
    refused(
        main(["plot", "overlay", str(photo), files[1], "--out", str(photo)]), "shot.png: an input"
    )
    bank = ["bank", str(folder / "truck.ply"), "--quiet", "--out"]
    refused(main([*bank, str(tmp_path / "bank.safetensors")]), "bank.safetensors: exists")
    assert {path.read_text() for path in tmp_path.glob("[bp]*") if path.name != "mine.png"} == {
        "of others"
    }


FAILURES = {
    "unreadable photograph": ["text.jpg", "truck.safetensors"],
    "missing photograph": ["missing.png", "truck.safetensors"],
    "one colour": ["flat.png", "truck.safetensors"],
    "missing mesh": ["photos/1.png", "missing.ply"],
    "missing camera": ["photos/1.png", "truck.safetensors", "--camera", "missing.yaml"],
}


@pytest.mark.parametrize("words", FAILURES.values(), ids=FAILURES.keys())
def test_a_photograph_that_fails_leaves_no_result_of_another(folder, register, tmp_path, words):
    """A robot would read the old pose."""
    given = ["--box", *box_of(0), "--format", "ros"]
    camera = ["--camera", *CAMERA]
    first = [folder / "photos" / "0.png", folder / "truck.safetensors"]
    assert register(*first, *given, *camera) == 0
    out = tmp_path / "out"
    names = {path.name for path in out.iterdir()}
    assert names >= {"result.json", "overlay.png", "pose.glb", "pose.yaml", "tf.yaml"}
    photo, mesh, *options = words
    assert register(folder / photo, folder / mesh, *given, *(options or camera)) == 2
    assert {path.name for path in out.iterdir()} == {MARKER}


WRONG = {
    "register": ("--pipeline", "--start", "--boxes", "--camera", "--field"),
    "register several": ("--pipeline", "--boxes"),
    "follow": ("--pipeline", "--start", "--boxes", "--field"),
    "inspect": ("--pipeline",),
    "demo": ("--pipeline",),
}


@pytest.mark.parametrize(
    ("command", "option"), [(command, option) for command, some in WRONG.items() for option in some]
)
def test_a_mistake_in_an_option_makes_and_empties_no_folder(
    folder, refused, tmp_path, command, option
):
    mesh = [folder / "truck.safetensors"]
    photos = [folder / "photos" / f"{seed}.png" for seed in (0, 1)]
    given = {
        "register": ["register", *photos[:1], *mesh],
        "register several": ["register", *photos, *mesh],
        "follow": ["follow", folder / "photos", *mesh],
        "inspect": ["inspect", folder / "truck.ply"],
        "demo": ["demo"],
    }
    camera = ["--camera", *CAMERA] if option in ("--start", "--boxes") else []
    out = tmp_path / "out"
    words = [*given[command], *camera, option, tmp_path / "none.json", "--out", out, "--quiet"]
    refused(main([*map(str, words)]), "none.json")
    assert not out.exists()
    if command == "register":  # the pose of another photograph goes, see above
        return
    name = "results.csv" if command in ("register several", "follow") else "inspect.json"
    name = "result.json" if command == "demo" else name
    with output_folder(out, command):
        (out / name).write_text("an earlier result")
    refused(main([*map(str, words)]), "none.json")
    assert (out / name).read_text() == "an earlier result"
