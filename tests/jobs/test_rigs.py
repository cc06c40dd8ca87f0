"""What reading a rig or a list costs; tests/cli/test_views.py checks what is read."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from curvireg_torch.errors import MAX_LIST_COLUMNS, MissingFileError
from curvireg_torch.formats.cameras import files as calibrations
from curvireg_torch.geometry import Camera
from curvireg_torch.jobs import rigs
from curvireg_torch.jobs.entry import Entry
from curvireg_torch.jobs.lists import read_list
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.jobs.photograph import prepare_views
from curvireg_torch.jobs.rigs import read_rig
from curvireg_torch.utils.files import only_in
from tests._support import double, eye, refused
from tests._support.doubling import check_linear
from tests._support.lists import written
from tests._support.miniature import write_json
from tests._support.spies import spied

POSE = [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1]
COLUMNS = "photo,camera," + ",".join((*rigs.ROTATION, *rigs.TRANSLATION))
CALIBRATION = {"camera_matrix": [300.0, 0, 1, 0, 300, 1, 0, 0, 1]}
LENS = Camera([[260.0, 0, 119.5], [0, 260, 89.5], [0, 0, 1]], size=(180, 240))
LINE = "1 PINHOLE 640 480 500 500 320 240"


@pytest.fixture
def images(tmp_path):
    """Write photographs of COLMAP beside its camera."""
    (tmp_path / "cameras.txt").write_text(LINE)
    return (tmp_path / "images.txt").write_text


@pytest.fixture
def rig(tmp_path):
    """Write rows of a rig, beside its camera, and read it."""
    (tmp_path / "cameras.txt").write_text(LINE)
    return lambda header, *rows: read_rig(written(tmp_path / "rig.csv", header, *rows))


NAMES = ("a{many}b.png", "{many}", "a{many}", "a/{many}/b")
NUMBERS = ("1" * 9 + " {many}", "1 1 0 0 0 0 0 1 {many}", "{many} " * 9, "1 " * 7 + "{many}")


@pytest.mark.parametrize(
    ("line", "many", "size"),
    [
        *(("1 1 0 0 0 0 0 1 1 " + name, " ", 20_000) for name in NAMES),
        *((line, "1", 100_000) for line in NUMBERS),
    ],
)
def test_lines_of_colmap_are_read_in_linear_time(tmp_path, images, line, many, size):
    def make(count):
        images(line.format(many=many * count))

    check_linear(lambda _: read_rig(tmp_path, find=only_in(tmp_path)), make, size)


def test_a_name_of_colmap_keeps_its_inner_blanks(tmp_path, images):
    images("  7  1 0 0 0   0 0 1  1   a  b.png \t\n\n")
    (view,) = read_rig(tmp_path)
    assert (view.name, view.photo) == ("image a  b.png", tmp_path / "a  b.png")
    for line in ("1 {} 1 1", "1 {} 1 x a.png", "x {} 1 1 a.png", "1 {} x 1 a.png"):
        images(line.format("1 0 0 0 0 0"))
        with refused(r"images\.txt: expected IMAGE_ID QW"):
            read_rig(tmp_path)


def test_each_calibration_is_read_once_whatever_number_of_rows_names_it(tmp_path, rig, monkeypatch):
    read = spied(monkeypatch, calibrations, "read_document")

    def check_read(*names):
        assert sorted(file.name for (file,) in read) == [*names]
        read.clear()

    write_json(tmp_path / "a.json", {f"c{k}": CALIBRATION for k in range(5)})
    write_json(tmp_path / "b.json", CALIBRATION)
    names = [*(f"a.json:c{k}" for k in range(5)), "b.json", "b.json"]
    rows = [[f"{k}.png", name, *POSE] for k, name in enumerate(names)]
    assert len(rig(COLUMNS, *rows)) == 7
    check_read("a.json", "b.json")
    rows = [[f"{k}.png", 0, 0, 9, 9, name] for k, name in enumerate(names)]
    photos = written(tmp_path / "list.csv", "photo,x0,y0,x1,y1,camera", *rows)
    entries = read_list(photos, RegisterOptions(meshes=(tmp_path / "a.ply",)))
    assert [entry.error for entry in entries] == [""] * 7
    check_read("a.json", "b.json")
    cameras = [LINE.replace("1 ", f"{k} ", 1) for k in range(7)]
    (tmp_path / "cameras.txt").write_text("\n".join(cameras))
    images = [f"{k} 1 0 0 0 0 0 1 {k} {k}.png\n\n" for k in range(7)]
    (tmp_path / "images.txt").write_text("".join(images))
    assert len(read_rig(tmp_path)) == 7
    check_read("cameras.txt")


def test_rigs_and_lists_are_bounded(tmp_path, rig, monkeypatch):
    monkeypatch.setattr(rigs, "MAX_RIG_VIEWS", 2)
    write_json(tmp_path / "b.json", CALIBRATION)
    rows = [[f"{k}.png", "b.json", *POSE] for k in range(3)]
    assert len(rig(COLUMNS, *rows[:2])) == 2
    with refused(r"rig\.csv: more than 2 photographs; leave some out"):
        rig(COLUMNS, *rows)
    options = RegisterOptions(meshes=(tmp_path / "a.ply",))
    header = "photo,x0,y0,x1,y1" + "".join(f",c{k}" for k in range(MAX_LIST_COLUMNS - 5))
    row = ["a.png", *[""] * (MAX_LIST_COLUMNS - 1)]
    assert len(read_list(written(tmp_path / "a.csv", header, row), options)) == 1
    with refused(r"a\.csv: more than 1,000 columns; leave some out"):
        read_list(written(tmp_path / "a.csv", f"{header},more", [*row, ""]), options)


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "x" * 300, "/", "..", "."])
def test_names_that_no_file_can_have_are_missing_files(tmp_path, name):
    rig = written(tmp_path / "rig.csv", COLUMNS, ["0.png", name, *POSE])
    for find in (None, only_in(tmp_path)):
        with refused("no such file", MissingFileError):
            read_rig(rig, find=find)


IMAGES = ONE, TWO, THREE = [f"{k} 1 0 0 0 0 0 1 1 {k}.png" for k in (1, 2, 3)]
LAYOUTS = {
    "no points": IMAGES,
    "empty points": [line for image in IMAGES for line in (image, "")],
    "points": [line for image in IMAGES for line in (image, "1.5 2 -1 3 4 17")],
    "points of some": [ONE, "1 2 3", TWO, THREE, "", "# the end"],
    "blank lines": ["", ONE, "", "", TWO, "1.5 2 -1", "", THREE],
    "points like an image": [ONE, "1 1 0 0 0 0 0 1 1 2 3 4", TWO, THREE],
}


@pytest.mark.parametrize("lines", LAYOUTS.values(), ids=LAYOUTS)
def test_every_photograph_of_colmap_is_read_with_and_without_lines_of_points(
    tmp_path, images, lines
):
    images("\n".join(lines))
    assert [view.name for view in read_rig(tmp_path)] == [f"image {k}.png" for k in (1, 2, 3)]
    images("\n".join([ONE, "1 2 3.5", TWO]))
    with refused("expected IMAGE_ID"):
        read_rig(tmp_path)


@pytest.mark.parametrize(
    ("columns", "cells", "message"),
    [
        (",photo", ["b.png"], "header: two columns photo"),
        (",mask,azimuth", ["m.png", 30], "header: a rig takes no azimuth, mask; leave these"),
        ("", ["5"], r"row 1: a\.png: '5' is beyond the last column"),
        (",qw,qx,qy,qz", [1, 0, 0, 0], r"row 1: a\.png: r11 to r33 and qw to qz"),
    ],
)
def test_rows_of_a_rig_with_too_much_are_refused(rig, columns, cells, message):
    with refused(message):
        rig(COLUMNS + columns, ["a.png", "cameras.txt", *POSE, *cells])


QUATERNION_COLUMNS = "photo,camera,qw,qx,qy,qz,tx,ty,tz"


def test_a_quaternion_begins_with_its_real_part(rig):
    """A quarter turn about z."""
    half = 0.5**0.5
    row = ["a.png", "cameras.txt", half, 0, 0, half, 4, 5, 6]
    (view,) = rig(QUATERNION_COLUMNS, row)
    expected = double([[0.0, -1, 0, 4], [1, 0, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]])
    torch.testing.assert_close(view.T_cam_from_world, expected)


@pytest.mark.parametrize("length", [0.98, 1.02])
def test_quaternions_have_length_one(rig, length):
    row = ["a.png", "cameras.txt", length, 0, 0, 0, 4, 5, 6]
    with refused(f"of length 1, got {length}; check their order"):
        rig(QUATERNION_COLUMNS, row)


def test_empty_cells_beyond_the_header_of_a_rig_do_not_count(rig):
    assert len(rig(f"{COLUMNS},,", ["a.png", "cameras.txt", *POSE, "", " ", ""])) == 1


K = [260.0, 0.0, 119.5, 0.0, 260.0, 89.5, 0.0, 0.0, 1.0]
EYE = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
CAMERA = {"cam_K": K, "cam_R_w2c": EYE, "cam_t_w2c": [0.0, 0.0, 600.0]}


def write_scene(folder, **parts):
    for name, content in parts.items():
        write_json(folder / f"scene_{name}.json", content)


TRUTHS = ({"obj_id": 5}, [5], ["obj_id"], "obj_id")
SKEWED = ([*K[:place], 2.0, *K[place + 1 :]] for place in (1, 3, 6))
NO_POSE = r"no cam_R_w2c in scene_camera\.json.* register these photographs one by one"


@pytest.mark.parametrize(
    ("camera", "truth", "message"),
    [
        *((CAMERA, truth, r"expected a list of objects in scene_gt\.json") for truth in TRUTHS),
        ({"cam_K": K}, [], NO_POSE),
        *(({**CAMERA, "cam_K": matrix}, [], r"cam_K in scene_camera\.json") for matrix in SKEWED),
    ],
)
def test_scenes_of_bop_that_are_no_rig_are_refused(tmp_path, camera, truth, message):
    write_scene(tmp_path, camera={"7": camera}, gt={"7": truth})
    with refused(f"image 7: {message}"):
        read_rig(tmp_path, Path("obj_000005.ply"))


def test_a_photograph_of_colmap_whose_name_is_a_number_is_no_line_of_points(tmp_path, images):
    images("1 1 0 0 0 0 0 1 1 7\n2 1 0 0 0 0 0 1 1 8\n")
    assert [view.name for view in read_rig(tmp_path)] == ["image 7", "image 8"]


def test_a_photograph_of_bop_that_does_not_show_the_object_has_no_box(tmp_path):
    truth = {"0": [{"obj_id": 2}]}
    boxes = {"0": [{"bbox_obj": [10, 5, 20, 30]}]}
    write_scene(tmp_path, camera={"0": CAMERA}, gt=truth, gt_info=boxes)
    (view,) = read_rig(tmp_path, Path("obj_000001.ply"))
    assert view.box is None


def view(photo, camera, scale=1.0):
    return Entry(name=photo.name, photo=photo, camera=camera, T_cam_from_world=scale * eye(4))


def test_a_photograph_that_does_not_fit_its_camera_leaves_the_others(tmp_path):
    """It counts as one that cannot be read."""
    for name, size in (("0.png", (240, 180)), ("1.png", (240, 90)), ("2.png", (480, 360))):
        Image.new("RGB", size).save(tmp_path / name)
    names = ("0.png", "1.png", "none.png", "2.png")
    first, narrow, missing, last = prepare_views([view(tmp_path / name, LENS) for name in names])
    assert (first.size, last.size) == ((180, 240), (360, 480))
    assert float(last.K[0, 0]) == 520.0
    assert "another aspect ratio" in str(narrow)
    assert isinstance(missing, MissingFileError)


def test_rows_of_a_rig_have_the_camera_at_the_size_of_the_photograph(tmp_path, monkeypatch):
    """That of one which cannot be used as it was given."""
    camera = replace(LENS, distortion=(0.1, 0.0, 0.0, 0.0))
    Image.new("RGB", (480, 360)).save(tmp_path / "0.png")
    rig = [view(tmp_path / "0.png", camera), view(tmp_path / "none.png", camera, scale=2.0)]
    monkeypatch.setattr(rigs, "register_views", lambda *_: None)
    monkeypatch.setattr(rigs, "result_document", lambda *_: {"photographs": [{}, {}]})
    found = rigs.register_rig(Path("rig"), rig, prepare_views(rig), None, bank_seconds=0.0)
    first, second = found.document["photographs"]
    assert first["camera"] == camera.at((360, 480)).describe() != camera.describe()
    assert second["camera"] == camera.describe()
    assert (first["name"], second["T_cam_from_world"][0]) == ("0.png", [2.0, 0.0, 0.0, 0.0])
