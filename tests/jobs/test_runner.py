"""The loop over entries, with a function in place of the registration."""

import weakref
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock, patch

import numpy as np
import pytest
import torch

from curvireg_torch import Camera, PosePrior
from curvireg_torch.errors import (
    InvalidInputError,
    MeshError,
    MissingDependencyError,
    WorkerError,
)
from curvireg_torch.formats.poses import PoseRecord
from curvireg_torch.jobs import runner
from curvireg_torch.jobs.entry import Entry
from curvireg_torch.jobs.runner import run_entries
from curvireg_torch.utils import sources
from curvireg_torch.utils.executors import Workers
from curvireg_torch.utils.files import write_file


@pytest.fixture
def entries(tmp_path, threads):
    """Four entries: two photographs, each with two meshes in turn; one mesh has a texture."""
    threads(1)
    for name in ("0.png", "1.png", "skin.png"):
        (tmp_path / name).write_text(name)
    (tmp_path / "a.stl").write_text("a")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    face = "usemtl skin\nf 1/1 2/2 3/3\n"
    (tmp_path / "b.obj").write_text(f"mtllib skin.mtl\n{corners}{face}")
    (tmp_path / "skin.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    pairs = [(photo, mesh) for photo in ("0.png", "1.png") for mesh in ("a.stl", "b.obj")]
    return [
        Entry(photo=tmp_path / p, meshes=(tmp_path / m,), label=f"{p[0]}{m[0]}") for p, m in pairs
    ]


HOW = {"settings": {}, "label": "", "progress": False}


def registered(entries, *, stop_after=None, **how):
    """The labels of the entries that a run registers, in their order, into a folder beside their
    photographs; Ctrl-C after ``stop_after`` of them."""
    folder = entries[0].photo.parent / "out"
    labels = []
    opened = []

    def register(block, registrar, *, bank_seconds):
        for entry in block:
            if len(labels) == stop_after:
                raise KeyboardInterrupt
            labels.append(entry.label)
            assert str(registrar) == entry.meshes[0].name
        is_first = sum(label[1] == block[0].label[1] for label in labels) == len(block)
        assert (bank_seconds > 0) == is_first, "the first block pays for the bank"
        return [({"verdict": "reliable"}, None)] * len(block)

    def open_registrar(meshes):
        assert not any(reference() for reference in opened), (
            "that of the mesh before is still in memory"
        )
        error = MeshError(meshes[0].name)  # in a cycle, by its traceback, as a mesh is
        opened.append(weakref.ref(error))
        raise error

    try:
        with patch.object(runner, "_rows", register):
            registered.store = run_entries(entries, folder, open_registrar, **HOW | how)
    except KeyboardInterrupt:
        assert stop_after is not None
    return labels


def test_entries_of_one_mesh_follow_each_other(entries):
    assert registered(entries) == ["0a", "1a", "0b", "1b"]
    assert registered(entries) == []
    assert registered(entries[::-1]) == [], "in any order"


AGAIN = {
    "0.png": "0a 0b",
    "a.stl": "0a 1a",
    "b.obj": "0b 1b",
    "skin.mtl": "0b 1b",
    "skin.png": "0b 1b",
}


@pytest.mark.parametrize(("name", "again"), AGAIN.items())
def test_changed_files_are_registered_again(entries, tmp_path, name, again):
    registered(entries)
    (tmp_path / name).write_text((tmp_path / name).read_text() + "\n# changed\n")
    assert registered(entries) == again.split()
    assert registered(entries) == []


def test_other_requests_settings_and_code_are_registered_again(entries, monkeypatch):
    registered(entries)
    changed = [replace(entries[0], box=(1.0, 2.0, 3.0, 4.0)), *entries[1:]]
    assert registered(changed) == ["0a"]
    for count in (4, 0):
        assert len(registered(changed, settings={"hypotheses": 2})) == count
    monkeypatch.setattr(runner, "results_digest", lambda: "newer")
    assert len(registered(changed, settings={"hypotheses": 2})) == 4


@pytest.mark.parametrize(
    ("changed", "count"),
    [
        ("jobs/photograph.py", 4),
        ("registration/constants.json", 4),
        ("terms.py", 4),
        ("viewer/page.py", 0),
        ("cli/register.py", 0),
        ("visualization/overlay.py", 0),
    ],
)
def test_rows_of_other_code_are_registered_again(changed, count, entries, tmp_path, monkeypatch):
    package = tmp_path / "package"
    for name in ("cli/a.py", "viewer/b.py", "visualization/c.py", changed):
        write_file(package / name, b"x = 1")
    monkeypatch.setattr(sources, "PACKAGE", package)
    sources.package_digest.cache_clear()
    registered(entries)
    write_file(package / changed, b"x = 2")
    sources.package_digest.cache_clear()
    assert len(registered(entries)) == count
    monkeypatch.undo()
    sources.package_digest.cache_clear()


def test_missing_photographs_are_tried_again(entries):
    entries[0].photo.unlink()
    assert registered(entries) == ["0a", "1a", "0b", "1b"]
    assert registered(entries) == ["0a", "0b"]
    assert registered.store.read("0a")["digests"]["photo"] == ""


def test_interrupted_run_keeps_what_is_done(entries):
    assert registered(entries, stop_after=2) == ["0a", "1a"]
    assert registered(entries) == ["0b", "1b"]


def test_textures_of_another_folder_are_digested(entries, tmp_path):
    """``--textures``: what is read counts, whatever names it, and not the name of its folder."""
    (tmp_path / "skin.png").rename(tmp_path / "moved.png")
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "skin.png").write_text("red")
    one, two = ([tmp_path / name] for name in ("one", "two"))
    assert len(registered(entries, textures=one)) == 4
    assert registered(entries, textures=two) == []
    (tmp_path / "one" / "skin.png").write_text("blue")
    assert registered(entries, textures=one) == ["0b", "1b"]
    assert registered(entries, textures=one) == []


def test_only_photographs_with_a_row_are_digested_before_they_are_registered(
    entries, tmp_path, monkeypatch
):
    """The first of a long list does not wait for the digests of all."""
    digested = []

    def digest(path):
        digested.append(path.name)
        return "unchanged"

    def register(_, tasks):
        before.append(list(digested))
        digests = [{"request": task.request, "photo": "unchanged"} for task in tasks]
        return [runner.Finished({"digests": d, "verdict": "reliable"}, None) for d in digests]

    monkeypatch.setattr(runner, "file_digest", digest)
    monkeypatch.setattr(runner, "_register_block", register)
    for expected, count in (([[], []], []), ([], ["0.png", "1.png"])):
        before = []
        run_entries(entries, tmp_path / "out", None, **HOW)
        assert before == expected
        assert digested == count, "each file once, as the video of many frames"


def test_a_video_is_digested_once_for_the_frames_of_a_block(entries, monkeypatch):
    digest = Mock(return_value="of all frames")
    monkeypatch.setattr(runner, "file_digest", digest)
    monkeypatch.setattr(runner, "_rows", lambda block, *_, **__: [({}, None)] * len(block))
    tasks = [runner.Task(entries[0], "request")] * 3
    found = runner._register_block(Mock(of=lambda _: (None, 0.0)), tasks)
    assert [one.row["digests"]["photo"] for one in found] == ["of all frames"] * 3
    digest.assert_called_once_with(entries[0].photo)


def test_a_photograph_that_ends_its_worker_fails_and_is_tried_again(entries):
    """The others keep their rows."""

    class OneLost(Workers):
        def map(self, function, state, blocks):
            for task, result in super().map(function, state, blocks):
                is_lost = task.entry.label == "1a"
                yield task, WorkerError("workers: a process ended") if is_lost else result

    assert len(registered(entries, workers=OneLost())) == 4
    row = registered.store.read("1a")
    assert (row["verdict"], row["message"]) == ("failed", "workers: a process ended")
    assert row["seconds"] == {"bank": 0.0, "register": 0.0}
    assert registered(entries) == ["1a"]


@pytest.mark.parametrize(("error", "tries"), [(MissingDependencyError, 2), (MeshError, 1)])
@pytest.mark.parametrize("name", ["image", "mesh"])
def test_files_for_which_a_package_is_missing_are_tried_again(
    name, error, tries, entries, tmp_path, monkeypatch
):
    """It is installed, and no file changes."""
    steps = {"image": Mock(), "mesh": Mock()}
    steps[name].side_effect = error("install it")
    monkeypatch.setattr(Entry, "read", steps["image"])
    for count in (1, 2):
        row = run_entries(entries[:1], tmp_path, steps["mesh"], **HOW).read("0a")
        assert (row["skipped"], row["message"]) == (f"unreadable_{name}", "install it")
        assert steps[name].call_count == min(count, tries)


def test_the_first_of_a_block_pays_for_the_bank(monkeypatch):
    monkeypatch.setattr(Entry, "read", Mock())
    monkeypatch.setattr(runner, "prepare", Mock(side_effect=InvalidInputError("an empty box")))
    rows = runner._rows([Entry(), Entry()], Mock(), bank_seconds=2.0)
    assert [row["seconds"]["bank"] for row, _ in rows] == [2.0, 0.0]


def test_a_missing_photograph_beside_others_is_tried_again(entries, tmp_path):
    """Of several photographs of one pose."""
    gone = replace(VIEWS[0], photo=tmp_path / "gone.png")
    rig = [replace(entries[0], views=(gone,)), replace(entries[2], views=(gone,))]
    for _ in range(2):
        assert registered(rig) == ["0a", "1a"]
    gone.photo.write_text("found again")
    for labels in (["0a", "1a"], []):
        assert registered(rig) == labels


CAMERA = Camera(torch.eye(3))
ENTRY = Entry(
    {"note": "x"}, "x.png", Path("x.png"), (Path("x.ply"),), box=(1.0, 2.0, 3.0, 4.0), camera=CAMERA
)
VIEWS = (Entry(name="z.png", photo=Path("z.png"), camera=CAMERA, T_cam_from_world=torch.eye(4)),)
CHANGED_VIEWS = (
    {},
    {"box": (1.0, 2.0, 3.0, 4.0)},
    {"camera": Camera(torch.diag(torch.tensor([2.0, 2.0, 1.0])))},
    {"T_cam_from_world": 2.0 * torch.eye(4)},
)
CHANGES = {
    "name": ["y.png"],
    "instances": [2],
    "as_stored": [True],
    "views": [(replace(VIEWS[0], **change),) for change in CHANGED_VIEWS],
    "prior": [PosePrior(distance=(1.0, 2.0))],
    "start": [
        PoseRecord(np.eye(4)),
        PoseRecord(2.0 * np.eye(4)),
        PoseRecord(np.eye(4), unit="mm"),
        PoseRecord(np.eye(4), confidence=0.5),
    ],
    "box": [(1.0, 2.0, 3.0, 4.25), None],
    "camera": [replace(CAMERA, size=(5, 6)), None, "exif", 50.0],
}


def test_request_covers_every_option_and_other_views():
    assert ENTRY.request() == replace(ENTRY).request()
    assert ENTRY.key == replace(ENTRY, cells={"note": "y"}).key
    seen = {ENTRY.key: ()}
    for name, values in CHANGES.items():
        for value in values:
            key = replace(ENTRY, **{name: value}).key
            assert key not in seen, (name, value, seen[key])
            seen[key] = name, value
