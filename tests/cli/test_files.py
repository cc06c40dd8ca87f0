"""Other files of ``curvireg register``: the page of a list, GLB and pipes that nobody reads."""

import base64
import html
import io
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import trimesh

from curvireg_torch.errors import InvalidInputError
from curvireg_torch.formats.exports import trackers
from curvireg_torch.jobs import outputs
from curvireg_torch.jobs.outputs import MARKER
from curvireg_torch.visualization import sheet
from tests._support.lists import CAMERA, box_of, table, written


def test_list_page_shows_every_row_best_first(folder, register, tmp_path):
    hostile = "<script>alert(1)</script>.png"
    shutil.copy(folder / "photos" / "0.png", folder / "a&b.png")
    rows = [
        [hostile, *[""] * 4],
        ["photos/1.png", *box_of(1)],
        ["a&b.png", *box_of(0)],
        ["photos/2.png", *box_of(2)],
    ]
    path = written(folder / "list.csv", "photo,x0,y0,x1,y1", *rows)
    assert register("--list", path, folder / "truck.safetensors") == 0
    out = tmp_path / "out"
    page = (out / "index.html").read_text(encoding="utf-8")
    assert "<h1>4 photographs: 0 reliable, 3 unsure, 0 no match, 0 lost, 1 failed" in page
    assert not re.search(r'<script>alert|(src|href)="(?!data:)|http', page)
    figures = re.findall(r'<figure class="(\w+)">(.*?)</figure>', page, flags=re.DOTALL)
    # Nothing is calibrated: the order is that of the list.
    assert [int(re.search(r"<b>(\d+)</b>", text)[1]) for _, text in figures] == [2, 3, 4, 1]
    assert [kind for kind, _ in figures][-1] == "failed"
    for row, (_, text) in zip(np.roll(table(out), -1), figures, strict=True):
        assert html.escape(row["photo"]) in text
        pictures = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', text)
        assert len(pictures) == (row["verdict"] != "failed")
        for picture in pictures:
            pixels = cv2.imdecode(
                np.frombuffer(base64.b64decode(picture), np.uint8), cv2.IMREAD_COLOR
            )
            assert max(pixels.shape) <= sheet.SIDE
    assert "no such file" in figures[-1][1]


def test_register_writes_the_mesh_at_its_pose(register_one, registered, tmp_path, monkeypatch):
    out = tmp_path / "out"
    words = ["--no-refine", "--camera", *CAMERA]
    found = registered(*words)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    T = flip @ trimesh.load(out / "pose.glb").graph["object"][0]
    np.testing.assert_allclose(T[:3], np.c_[found["rotation"], found["translation"]], atol=1e-5)
    # For a mesh that is too large, none is written and an older one is removed.
    monkeypatch.setattr("curvireg_torch.jobs.result_files.MAX_GLB_FACES", 10)
    for more, files in (
        (["--format", "ros"], {"pose.yaml", "tf.yaml"}),
        (["--format", "m3t"], {*trackers.M3T_FILES}),
        (["--format", "visp"], {*trackers.VISP_FILES}),
        ([], set()),
    ):
        assert register_one(*words, *more) == 0
        names = {path.name for path in out.iterdir()}
        assert names & {"pose.glb", *outputs.FOR_TOOLS} == files


# Runs the command line with a command that prints text and imports nothing large
PRINTING = """
import sys
from curvireg_torch import __main__
from curvireg_torch.cli import commands
commands.show_cache = lambda arguments: print("x" * {count})
sys.exit(__main__.start())
"""


def ended(words, unbuffered, count=1, **files):
    """A process of the command line; the command ``cache`` prints so many letters."""
    return subprocess.run(
        [sys.executable, "-c", PRINTING.format(count=count), *words],
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=120,
        env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
        **files,
    )


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_main_ends_silently_when_the_reader_of_a_pipe_has_gone(unbuffered):
    """As in ``curvireg ... | head``: no message, and the exit code of shell tools."""
    reader, writer = os.pipe()
    os.close(reader)
    done = ended(["cache"], unbuffered, stdout=writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    ("words", "count"),
    [(["cache"], 1), (["cache"], 100_000), (["--version"], 0), (["register", "--help"], 0)],
)
def test_output_that_cannot_be_written_is_a_line_and_a_code(words, count, unbuffered):
    """The disk is full; what does not fit into the buffer of standard output, as the help, fails
    while the command runs."""
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")
    with open("/dev/full", "w") as full:
        done = ended(words, unbuffered, count, stdout=full)
    (line,) = done.stderr.splitlines()
    assert line.startswith("curvireg: error: standard output: cannot be written (No space left")
    assert done.returncode == 2


@pytest.mark.skipif(os.name != "posix", reason="a shell closes the outputs")
@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-"])
def test_a_command_runs_without_standard_output_and_error(closed):
    """As under some services."""
    command = ["sh", "-c", f'"$0" -c "$1" cache {closed}', sys.executable, PRINTING.format(count=1)]
    done = subprocess.run(command, capture_output=True, check=False, timeout=120)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("n", [1, 2], ids=["one thread", "two threads"])
@pytest.mark.parametrize(
    ("draws", "file"), [("pose_glb", "pose.glb"), ("registration_sheet", "overlay.png")]
)
def test_a_file_that_cannot_be_drawn_costs_no_other(
    register_one, tmp_path, monkeypatch, threads, draws, file, n
):
    threads(n)
    fail = Mock(side_effect=InvalidInputError("it cannot be drawn"))
    monkeypatch.setattr(f"curvireg_torch.jobs.photograph.{draws}", fail)
    assert register_one("--no-refine", "--camera", *CAMERA) == 2
    written = {path.name for path in (tmp_path / "out").iterdir()} - {MARKER}
    assert written == {"result.json", "overlay.png", "pose.glb"} - {file}


def test_a_photograph_whose_name_is_no_text_is_registered_and_named(
    folder, register_one, document, tmp_path, monkeypatch
):
    """Its bytes are no UTF-8; nothing was printed once the result was written."""
    photo = tmp_path / os.fsdecode(b"Gr\xfc\xdfe.png")
    shutil.copy(folder / "photos" / "0.png", photo)
    printed = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(printed, "utf-8", write_through=True))
    assert register_one("--no-refine", photo=photo) == 0
    assert b"viewpoint: " in printed.getvalue()
    assert document()["inputs"]["photo"] == str(photo)
