"""What ``curvireg register`` writes besides the poses: the page of a list, GLB, BOP csv; pipes that nobody reads."""

import base64
import html
import json
import os
import re
import shutil
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
import trimesh

from curvireg_torch import Registrar, camera_matrix
from curvireg_torch.cli import main
from curvireg_torch.data import read_bop_csv
from curvireg_torch.geometry import project_points
from curvireg_torch.io.meshes import load_mesh
from curvireg_torch.visualization import sheet
from tests._support.lists import CAMERA, box_of, lines, table, write_files, written
from tests._support.scenes import scene, truck_bank, unrefined


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("files"))


def register(folder, *words, out="out"):
    return main(["register", *map(str, words), "--out", str(folder / out), "--quiet", "--no-refine"])


def figures(page):
    return re.findall(r'<figure class="(\w+)">(.*?)</figure>', page, flags=re.DOTALL)


def test_the_page_shows_every_row_the_best_first(folder):
    hostile = "<script>alert(1)</script>.png"
    shutil.copy(folder / "photos" / "0.png", folder / "a&b.png")
    rows = [[hostile, *[""] * 4], ["photos/1.png", *box_of(1)], ["a&b.png", *box_of(0)], ["photos/2.png", *box_of(2)]]
    path = written(folder / "list.csv", "photo,x0,y0,x1,y1", *rows)
    assert register(folder, "--list", path, folder / "truck.safetensors") == 0
    page = (folder / "out" / "index.html").read_text(encoding="utf-8")
    assert "<h1>4 photographs: 3 ok, 1 failed" in page
    assert "<script>alert" not in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "http" not in page
    shown = figures(page)
    assert len(shown) == 4
    found = table(folder / "out")
    order = sorted(range(1, 4), key=lambda k: -float(found[k]["confidence"]))
    numbers = [int(re.search(r"<b>(\d+)</b>", text)[1]) for _, text in shown]
    assert numbers == [k + 1 for k in order] + [1]
    for number, (kind, text) in zip(numbers, shown, strict=True):
        row = found[number - 1]
        assert html.escape(row["photo"]) in text
        picture = re.search(r'src="data:image/jpeg;base64,([^"]+)"', text)
        if number == 1:
            assert kind == "failed"
            assert picture is None
            assert "no such file" in text
        else:
            assert kind == ("reliable" if row["reliable"] == "true" else "doubtful")
            pixels = cv2.imdecode(np.frombuffer(base64.b64decode(picture[1]), np.uint8), cv2.IMREAD_COLOR)
            assert max(pixels.shape) <= sheet.SIDE
    # Run again, nothing is computed and the page is the same.
    assert register(folder, "--list", path, folder / "truck.safetensors") == 0
    assert (folder / "out" / "index.html").read_text(encoding="utf-8") == page


@pytest.mark.parametrize("scale", [1, 4])
def test_contours_of_a_thumbnail_lie_on_the_object(scale):
    """The outline is where the mesh projects to, whatever was cut away and shrunk."""
    image, box, _ = scene(1)
    large = torch.nn.functional.interpolate(image[None], scale_factor=scale, mode="bilinear")[0]
    photograph = (large * 255).round().byte()
    edges = ((box + 0.5) * scale - 0.5).tolist()
    registrar = Registrar(truck_bank(), pipeline=unrefined(truck_bank()))
    result = registrar([photograph], [edges])[0]
    grey = torch.full_like(photograph, 100)
    jpeg = sheet.thumbnail(registrar.describers[0].renderer, result.projection, grey, edges)
    pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1)
    y, x = np.nonzero(pixels[..., 1].astype(int) - pixels[..., 2] > 60)  # the outline's green
    assert len(x) > 50
    # The same corners, from the photograph's pixels to the thumbnail's.
    T, K = result.projection
    uv = project_points(torch.as_tensor(registrar.bank.mesh.vertices, dtype=torch.float64), T[None], K)[0]
    room = 0.25 * max(edges[2] - edges[0], edges[3] - edges[1])
    left, top = int(edges[0] - room), int(edges[1] - room)
    shrink = pixels.shape[1] / (int(edges[2] + room) + 1 - left)
    wanted = [(v + 0.5 - start) * shrink - 0.5 for v, start in zip(uv.T, (left, top), strict=True)]
    for seen, where in zip((x, y), wanted, strict=True):
        # The box is drawn over the outermost pixels.
        assert abs(seen.min() - float(where.min())) <= 3
        assert abs(seen.max() - float(where.max())) <= 3


def test_of_many_the_best_and_the_worst_are_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(sheet, "SHOWN", 2)
    asked = []
    rows = [
        sheet.SheetEntry(number=k, name=f"{k}.png", caption="", kind="doubtful", picture=lambda k=k: asked.append(k))
        for k in range(7, 0, -1)
    ]
    sheet.write_sheet(tmp_path / "index.html", "7 photographs", rows, table="results.csv")
    page = (tmp_path / "index.html").read_text()
    assert [int(n) for n in re.findall(r"<b>(\d+)</b>", page)] == asked == [7, 6, 2, 1]
    assert "The 2 best, then the 2 worst; results.csv has them all" in page


def test_the_posed_mesh_is_written_beside_the_overlay(folder, monkeypatch):
    words = [folder / "photos" / "0.png", folder / "truck.safetensors", "--box", *box_of(0), "--camera", *CAMERA]
    assert register(folder, *words, out="one") == 0
    found = json.loads((folder / "one" / "result.json").read_text())
    posed = trimesh.load(folder / "one" / "pose.glb")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = found["rotation"], found["translation"]
    wanted = trimesh.transform_points(load_mesh(folder / "truck.ply").vertices, np.diag([1.0, -1, -1, 1]) @ T)
    place, name = posed.graph["object"]
    seen = trimesh.transform_points(posed.geometry[name].vertices, place)
    np.testing.assert_allclose([seen.min(0), seen.max(0)], [wanted.min(0), wanted.max(0)], atol=1e-5)
    # A mesh that is too large for viewers leaves none, nor an older one.
    monkeypatch.setattr("curvireg_torch.evaluation.result_files.MAX_GLB_FACES", 10)
    assert register(folder, *words, out="one") == 0
    assert not (folder / "one" / "pose.glb").exists()


def test_bop_csv_of_a_list_that_names_images_and_objects(folder):
    header = "photo,x0,y0,x1,y1,fx,fy,cx,cy,scene_id,im_id,obj_id"
    rows = [
        ["photos/0.png", *box_of(0), *CAMERA, "1", "7", "3"],
        ["photos/1.png", *box_of(1), *[""] * 4, "1", "8", "3"],
        ["none.png", *box_of(1), *CAMERA, "1", "9", "3"],
    ]
    path = written(folder / "bop.csv", header, *rows)
    assert register(folder, "--list", path, folder / "truck.safetensors", "--unit", "mm", out="bop") == 0
    (row,) = read_bop_csv(folder / "bop" / "bop.csv")
    found = lines(folder / "bop")[0]
    assert (row["scene_id"], row["im_id"], row["obj_id"], row["score"]) == (1, 7, 3, found["confidence"])
    assert row["R"].tolist() == found["rotation"]
    metres = torch.tensor(found["translation"], dtype=torch.float64)
    assert found["unit"] == "m"  # of the bank
    torch.testing.assert_close(row["t"].double(), metres * 1000, rtol=1e-6, atol=0)
    K = camera_matrix(*map(float, CAMERA), dtype=torch.float64)
    assert float((K @ metres)[2]) > 0


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_left_ends_the_command_quietly(unbuffered):
    """As in ``curvireg ... | head``: no message, and the exit code of a shell's own tools, whenever it is noticed."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "curvireg_torch", "schema"]
    said = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, env=said, check=False, timeout=120)
    os.close(writer)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, b"")
