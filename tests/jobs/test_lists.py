"""Registration of lists: what is repeated, what the tables and the page show, and names that are no
text."""

import os
from dataclasses import replace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch

from curvireg_torch import Camera, Registrar, camera_matrix
from curvireg_torch.data import read_photo
from curvireg_torch.errors import CurviregWarning
from curvireg_torch.formats.poses import PoseRecord
from curvireg_torch.jobs import lists, photograph, runner
from curvireg_torch.jobs.entry import Entry, camera_of, prepare, start_in_unit
from curvireg_torch.jobs.lists import find_photographs, list_photographs, read_list
from curvireg_torch.jobs.options import RegisterOptions
from curvireg_torch.pipeline import PRESETS
from curvireg_torch.synthetic import example_mesh
from tests._support import (
    SIZE,
    bank_around,
    double,
    eye,
    found_in,
    refused,
    scene,
    two_trucks,
    unrefined,
    write_photo,
)
from tests._support.lists import lines, table
from tests._support.tables import check_columns

CAMERA = Camera(camera_matrix(260.0, 260.0, 119.5, 89.5))
LENS = replace(CAMERA, distortion=(-1e-3, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def registrar():
    """The example mesh in eight views, without refinement."""
    bank = bank_around(example_mesh(), 45, [20], pipeline=PRESETS["classical"], image_size=64)
    return Registrar(bank, pipeline=unrefined(bank))


@pytest.fixture
def entry(tmp_path):
    """A photograph with its box."""
    image, box, _ = scene(0)
    photo = tmp_path / "photo.png"
    mesh = tmp_path / "mesh.ply"
    write_photo(photo, image)
    mesh.write_text("a mesh")
    return Entry({}, "photo.png", photo, (mesh,), box=tuple(box.tolist()))


@pytest.fixture
def register_rows(registrar, out):
    """Register rows; results go to ``out``."""

    def run(rows, **settings):
        how = {"settings": settings, "progress": False}
        return lists.register_list(rows, out, lambda _: registrar, **how)

    return run


def read(text, folder, **options):
    """The rows of a list."""
    path = folder / "list.csv"
    path.write_text(text, newline="")
    return read_list(path, RegisterOptions(meshes=(folder / "part.stl",), **options))


def test_register_list_registers_changed_rows_again(register_rows, entry, monkeypatch):
    changes = ({"camera": CAMERA}, {"box": None, "camera": CAMERA, "instances": 2})
    others = [replace(entry, **change) for change in (*changes, {"camera": 50.0})]
    rows = [entry, *others, entry]
    done = []

    def prepare_in_box(one, photo):
        done.append(one)
        return prepare(replace(one, box=entry.box, instances=1), photo)

    monkeypatch.setattr(runner, "prepare", prepare_in_box)
    for count in (1, 2):
        done.clear()
        for _ in range(2):
            assert register_rows(rows, hypotheses=count).posed == 5
        assert done == rows[:4], "equal rows are registered once"


@pytest.mark.parametrize("column", ["photo", " Photo"])
def test_results_of_photographs_that_a_list_no_longer_names_go(register_rows, entry, out, column):
    rows = [replace(entry, name=name, cells={column: f"{name} "}) for name in ("a.png", "b.png")]
    register_rows(rows)
    register_rows(rows)
    pictures = out / "thumbnails"
    (pictures / "holiday.jpg").write_text("of the user")
    assert len(list(pictures.iterdir())) == 3
    with pytest.warns(CurviregWarning, match="out: removed results of photographs .* has: 1$"):
        register_rows(rows[:1])
    (row,) = lines(out)
    left = {path.name for path in pictures.iterdir()}
    assert left == {"holiday.jpg", f"{row['digests']['request']}.jpg"}


def test_names_that_are_not_utf8_do_not_end_a_list(register_rows, entry, tmp_path, out):
    """Of a Latin-1 archive, for instance; they are written with their bytes in hexadecimal."""
    folder = tmp_path / "old"
    folder.mkdir()
    (folder / os.fsdecode(b"caf\xe9.png")).write_bytes(entry.photo.read_bytes())
    (folder / os.fsdecode(b"gar\xe7on.png")).write_text("no picture")
    photos = list_photographs(RegisterOptions((folder,), entry.meshes, entry.box))
    counts = register_rows(photos)
    assert (counts.posed, len(counts.failures)) == (1, 1)
    assert r"gar\udce7on.png" in counts.failures[0]
    rows = table(out)
    found = [(os.path.basename(row["photo"]), row["verdict"]) for row in rows]
    assert found == [(r"caf\udce9.png", "unsure"), (r"gar\udce7on.png", "failed")]
    assert r"caf\udce9.png" in (out / "index.html").read_text(encoding="utf-8")


def test_empty_columns_of_a_spreadsheet_do_not_count(tmp_path):
    """Excel ends every line by the commas of cells that were used once."""
    rows = "a.png,1,2,30,40,,,\nb.png,1,2,30,40,new,,\n,,,,,,,\nc.png,1,2,30,40,x,y,\n"
    found = read(f"Photo ,x0,Y0,x1,y1,note,,\n{rows}", tmp_path)
    assert list(found[0].cells) == ["Photo ", "x0", "Y0", "x1", "y1", "note"]
    assert [entry.cells["note"] for entry in found] == ["", "new", "x"]
    first, second, third = (entry.error for entry in found)
    assert first == second == ""
    assert third == "7 cells, the header has 6; quote texts with commas"
    # one within the table is passed through
    (entry,) = read("photo,x0,,y0,x1,y1,\na.png,1,,2,30,40,\n", tmp_path)
    assert entry.box == (1.0, 2.0, 30.0, 40.0)


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffphoto;x0;y0;x1;y1;fx;fy;cx;cy\r\na.png;1,5;2;30;4e1;110;110;47,5;35,5\r\n",
        "photo\tx0\ty0\tx1\ty1\tfx\tfy\tcx\tcy\na.png\t1,5\t2\t30\t40\t110\t110\t47,5\t35,5\n",
        "photo\tx0\ty0\tx1\ty1\tfx\tfy\tcx\tcy\na.png\t1.5\t2\t30\t40\t110\t110\t47.5\t35.5\n",
        "sep=;\nphoto;x0;y0;x1;y1;fx;fy;cx;cy\na.png;1,5;2;30;40;110;110;47,5;35,5\n",
        "sep=,\nphoto,x0,y0,x1,y1,fx,fy,cx,cy\na.png,1.5,2,30,40,110,110,47.5,35.5\n",
        "photo,x0,y0,x1,y1,fx,fy,cx,cy\na.png,1.5,2,30,40,110,110,47.5,35.5\n",
    ],
    ids=["semicolon", "tab", "tab, points", "sep=;", "sep=,", "comma"],
)
def test_lists_of_spreadsheets_have_other_separators_and_decimal_commas(tmp_path, text):
    (entry,) = read(text, tmp_path)
    assert entry.error == ""
    assert entry.box == (1.5, 2.0, 30.0, 40.0)
    assert entry.camera == (110.0, 110.0, 47.5, 35.5)


def test_names_with_commas_and_semicolons_stay_as_they_are(tmp_path):
    for text, name, note in (
        ("photo;x0;y0;x1;y1;note\na,1.png;1;2;30;40;1,5 mm\n", "a,1.png", "1,5 mm"),
        ('photo,x0,y0,x1,y1,note\n"a;1.png",1,2,30,40,"1,5"\n', "a;1.png", "1,5"),
    ):
        (entry,) = read(text, tmp_path)
        assert (entry.name, entry.cells["note"]) == (name, note)


def test_patterns_within_folders_with_brackets(tmp_path, monkeypatch):
    folder = tmp_path / "part [1]*"
    folder.mkdir()
    for name in ("a.png", "b.png", "c[2].png"):
        (folder / name).write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    assert len(find_photographs(tmp_path / "pa*" / "*.png")) == 3
    for start in (folder, folder.relative_to(tmp_path)):
        found = find_photographs(start / "[ab]*.png")
        assert found == [start / "a.png", start / "b.png"]
        assert len(find_photographs(start)) == 3
        for name in ("c[2].png", "lost.png"):
            assert find_photographs(start / name) == [start / name]
    monkeypatch.chdir(folder)
    assert find_photographs(tmp_path.relative_to(tmp_path) / "*.png")[0].name == "a.png"


FILES = [(replace(CAMERA, size=SIZE), "file"), (LENS, "file")]


@pytest.mark.parametrize(
    ("camera", "source"), [(CAMERA, "given"), *FILES, (50.0, "fov"), ("exif",) * 2, (None, "exif")]
)
def test_camera_of_names_its_source_and_a_panorama_needs_its_camera(
    entry, monkeypatch, camera, source
):
    photo = read_photo(entry.photo)
    assert camera_of(entry, photo) == (None, None), "without EXIF data"
    monkeypatch.setattr(type(photo), "guessed_camera_matrix", lambda _: CAMERA.matrix)
    wide = replace(photo, is_stitched=True)
    known = replace(entry, camera=camera)
    found, name = camera_of(known, photo)
    assert (name, found.source) == (source, "exif" if source == "exif" else "given")
    if source != "exif":
        assert camera_of(known, wide)[1] == source
    else:
        with refused(r"a panorama, .* ordinary photograph") as e:
            camera_of(known, wide)
        assert e.value.kind == "camera"
    for shown in (photo, wide):
        assert camera_of(replace(entry, as_stored=True), shown) == (None, None), "of a dataset"


def test_names_are_in_the_order_of_their_numbers(tmp_path):
    expected = ["1", "2", "10", "a09", "a9", "a10", "a", "b", "x1y2", "x1y10"]
    for name in (*sorted(expected), "._a"):  # the last is what a Mac leaves beside a.png
        (tmp_path / f"{name}.png").touch()
    assert [path.stem for path in find_photographs(tmp_path)] == expected
    assert [path.stem for path in find_photographs(tmp_path / "[ab]*.png")] == expected[3:8]


def test_the_page_of_a_list_begins_with_the_surest_answers(tmp_path, monkeypatch):
    pose = {"rotation": eye(3).tolist(), "translation": None, "warnings": [], "message": ""}
    pose |= {"digests": {"request": "r", "photo": "p"}, "verdict": "unsure", "reliable": False}
    pose["inputs"] = {"box": [0.0, 0.0, 9.0, 9.0]}
    rows = {
        "failed": {**pose, "verdict": "failed", "message": "no such file"},
        "unlikely": {**pose, "confidence": 0.0},
        "likely": {**pose, "confidence": 0.95},
        "sure": {**pose, "confidence": 0.92, "reliable": True},
        "surer": {**pose, "confidence": 0.99, "reliable": True},
    }
    shown = []
    monkeypatch.setattr(lists, "write_sheet", lambda _, __, entries, **___: shown.extend(entries))
    entries = [Entry({"photo": name, "instance": "7"}, name, label=name) for name in rows]
    lists._write_tables(entries, tmp_path, Mock(read=rows.get))
    assert {row["instance"] for row in table(tmp_path)} == {"7"}, "a column of the list itself"
    in_order = [one.name for one in sorted(shown, key=lambda one: one.rank)]
    assert in_order == ["surer", "sure", "likely", "unlikely", "failed"]


def test_every_copy_of_the_object_has_a_row_and_is_drawn(
    registrar, register_rows, entry, tmp_path, out, monkeypatch
):
    image, boxes = two_trucks()
    write_photo(tmp_path / "two.png", image)
    found = found_in(registrar, image, boxes)
    monkeypatch.setattr(photograph, "detect_prepared", lambda *_, **__: [found])
    cells = {"photo": "two.png", "note": "shelf"}
    shelf = Entry(cells, "two.png", tmp_path / "two.png", entry.meshes, instances=4)
    located = replace(shelf, cells={"photo": "one", "note": ""}, photo=entry.photo, box=entry.box)
    lost = Entry({"photo": "none", "note": ""}, "none", error="no such file")
    counts = register_rows([shelf, located, lost])
    assert (counts.posed, len(counts.failures)) == (2, 1)
    rows = table(out)
    check_columns(
        rows,
        photo=["two.png", "two.png", "one", "none"],
        instance=["1", "2", "1", ""],
        note=["shelf", "shelf", "", ""],
    )
    names = ("found_x0", "found_y0", "found_x1", "found_y1")
    assert list(rows[0])[-5:] == ["instance", *names]
    for row, box in zip(rows, [*boxes, torch.tensor(entry.box)], strict=False):
        assert [float(row[name]) for name in names] == pytest.approx(box.tolist(), abs=0.01)
    assert [rows[3][name] for name in names] == [""] * 4
    for row, result in zip(rows, found, strict=False):
        assert float(row["r11"]) == float(result.rotation[0, 0])
        assert row["verdict"] == result.verdict
        assert row["reliable"] == "false"
    assert "2 objects" in (out / "index.html").read_text()
    pictures = [cv2.imread(str(path)) for path in (out / "thumbnails").iterdir()]
    (picture,) = [pixels for pixels in pictures if pixels.shape[1] > 1.5 * pixels.shape[0]]
    blue, green, red = np.moveaxis(picture.astype(int), 2, 0)
    outline = green - np.maximum(blue, red) > 80
    for half in np.array_split(outline, 2, axis=1):
        assert half.sum() > 50


def test_columns_of_copies_are_reserved_only_where_copies_are_asked_for(tmp_path):
    text = "photo,x0,y0,x1,y1,found_x0\na.png,,,,,7\n"
    assert read(text, tmp_path)[0].cells["found_x0"] == "7"
    with refused("found_x0: names of result columns"):
        read(text, tmp_path, instances=2)


def test_a_long_list_makes_no_tensor_for_each_row(tmp_path, monkeypatch):
    """Of 10,000 rows, those would take seconds before the first word."""
    row = "a.png,1,2,30,40,260,260,119.5,89.5\n"
    for name in ("tensor", "zeros", "eye", "as_tensor"):
        monkeypatch.setattr(torch, name, Mock(side_effect=AssertionError("a tensor")))
    entries = read("photo,x0,y0,x1,y1,fx,fy,cx,cy\n" + row * 3, tmp_path)
    assert [entry.error for entry in entries] == [""] * 3
    assert len({entry.key for entry in entries}) == 1


@pytest.mark.parametrize(
    ("unit", "of_mesh", "factor"), [("mm", None, 1e-3), ("mm", "cm", 0.1), (None, "mm", 1.0)]
)
def test_a_start_pose_is_in_the_unit_of_the_mesh(unit, of_mesh, factor):
    """A mesh without a unit is in m; a pose without one is in that of the mesh."""
    T = eye(4)
    T[:3, 3] = torch.tensor([20.0, -10.0, 600.0])
    moved = double(start_in_unit(PoseRecord(T.numpy(), unit=unit), of_mesh))
    torch.testing.assert_close(moved[:3, 3], factor * T[:3, 3])
    assert torch.equal(moved[:3, :3], T[:3, :3])


def test_numbers_that_are_no_camera_are_the_error_of_their_row(entry):
    with refused("camera"):
        camera_of(replace(entry, camera=(-260.0, 260.0, 119.5, 89.5)), Mock())
