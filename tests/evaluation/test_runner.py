"""The loop over items, with a function in place of the registration."""

from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest.mock import patch

import pytest
import torch

from curvireg_torch import PosePrior
from curvireg_torch.errors import InvalidInputError, MeshError
from curvireg_torch.evaluation import runner
from curvireg_torch.evaluation.benchmark import BenchmarkItem
from curvireg_torch.evaluation.lists import Entry
from curvireg_torch.evaluation.runner import run_items
from curvireg_torch.evaluation.workers import Workers, run_processes, workers


@dataclass(frozen=True)
class Item:
    key: str
    photo: Path
    meshes: tuple[Path, ...]
    options: dict = field(default_factory=dict)

    def request(self):
        return self.options


@pytest.fixture
def items(tmp_path):
    """Four items: two photographs, each with two meshes in turn; one mesh has a texture."""
    for name in ("0.png", "1.png", "skin.png"):
        (tmp_path / name).write_text(name)
    (tmp_path / "a.stl").write_text("a")
    text = "mtllib skin.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl skin\nf 1/1 2/2 3/3\n"
    (tmp_path / "b.obj").write_text(text)
    (tmp_path / "skin.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    pairs = [(photo, mesh) for photo in ("0.png", "1.png") for mesh in ("a.stl", "b.obj")]
    return [Item(f"{p[0]}{m[0]}", tmp_path / p, (tmp_path / m,)) for p, m in pairs]


def registered(items, folder, *, settings=None, row=None, workers=None, register=None):
    """The keys of the items that a run registers, in their order."""
    keys = []

    def plain(item, registrar, seconds, _):
        keys.append(item.key)
        assert str(registrar) == item.meshes[0].name
        assert (seconds > 0) == (sum(key[1] == item.key[1] for key in keys) == 1), "the first pays for the bank"
        return row or {}

    with patch.object(runner, "workers", lambda: nullcontext(workers or Workers())):
        run_items(
            items, folder, lambda meshes: MeshError(meshes[0].name), register or plain,
            settings=settings or {}, prepare=lambda _: None, label="", progress=False,
        )  # fmt: skip
    return keys


def test_items_of_one_mesh_follow_each_other(items, tmp_path):
    assert registered(items, tmp_path / "out") == ["0a", "1a", "0b", "1b"]
    assert registered(items, tmp_path / "out") == []
    assert registered(items[::-1], tmp_path / "out") == [], "in any order"
    parts = [registered(items, tmp_path / "two", workers=Workers(rank, 2)) for rank in (0, 1)]
    assert parts == [["0a", "1a"], ["0b", "1b"]]
    parts = [registered(items, tmp_path / "eight", workers=Workers(rank, 8)) for rank in range(8)]
    assert [key for part in parts for key in part] == ["0a", "1a", "0b", "1b"]


@pytest.mark.parametrize(
    ("name", "again"),
    [
        ("0.png", ["0a", "0b"]),
        ("a.stl", ["0a", "1a"]),
        ("b.obj", ["0b", "1b"]),
        ("skin.mtl", ["0b", "1b"]),
        ("skin.png", ["0b", "1b"]),
    ],
)
def test_changed_files_are_registered_again(items, tmp_path, name, again):
    registered(items, tmp_path / "out")
    (tmp_path / name).write_text((tmp_path / name).read_text() + "\n# changed\n")
    assert registered(items, tmp_path / "out") == again
    assert registered(items, tmp_path / "out") == []


def test_other_requests_settings_and_code_are_registered_again(items, tmp_path, monkeypatch):
    registered(items, tmp_path / "out")
    changed = [replace(items[0], options={"box": 1}), *items[1:]]
    assert registered(changed, tmp_path / "out") == ["0a"]
    assert len(registered(changed, tmp_path / "out", settings={"top": 2})) == 4
    assert registered(changed, tmp_path / "out", settings={"top": 2}) == []
    monkeypatch.setattr(runner, "code_digest", lambda *_: "newer")
    assert len(registered(changed, tmp_path / "out", settings={"top": 2})) == 4


def test_skipped_and_missing_items_are_tried_again(items, tmp_path):
    items[0].photo.unlink()
    for _ in range(2):
        assert registered(items, tmp_path / "out") == (["0a", "0b"] if _ else ["0a", "1a", "0b", "1b"])
    for _ in range(2):
        assert len(registered(items, tmp_path / "skipped", row={"skipped": "unknown_box"})) == 4


def test_interrupted_run_keeps_what_is_done(items, tmp_path):
    done = []

    def register(item, *_):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(item.key)
        return {}

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with pytest.raises(KeyboardInterrupt):
            registered(items, tmp_path / "out", register=register)
    finally:
        torch.set_num_threads(threads)
    assert done == ["0a", "1a"]
    assert registered(items, tmp_path / "out") == ["0b", "1b"]


ENTRY = Entry(("x",), "x.png", Path("x.png"), (Path("x.ply"),), box=(1.0, 2.0, 3.0, 4.0), camera=(5.0, 5.0, 6.0, 7.0))
OBJECT = BenchmarkItem("x", 0, Path("x.png"), (Path("x.ply"),), torch.arange(4.0), torch.eye(3).double())


def moved(tensor, place):
    tensor = tensor.clone()
    tensor.view(-1)[place] += 1e-3
    return tensor


@pytest.mark.parametrize(
    ("item", "changes"),
    [
        (ENTRY, {"name": "y.png"}),
        (ENTRY, {"box": (1.0, 2.0, 3.0, 4.25)}),
        (ENTRY, {"box": None}),
        (ENTRY, {"camera": (5.0, 5.0, 6.25, 7.0)}),
        (ENTRY, {"camera": None}),
        (ENTRY, {"guess": "exif"}),
        (ENTRY, {"guess": 50.0}),
        (ENTRY, {"instances": 2}),
        (ENTRY, {"prior": PosePrior(distance=(1.0, 2.0))}),
        (OBJECT, {"camera_matrix": None}),
        *[(OBJECT, {"box": moved(OBJECT.box, place)}) for place in range(4)],
        *[(OBJECT, {"camera_matrix": moved(OBJECT.camera_matrix, place)}) for place in (0, 2, 4, 5)],
    ],
)
def test_request_covers_every_option(item, changes):
    changed = replace(item, **changes)
    assert changed.request() != item.request() == replace(item).request()
    if isinstance(item, Entry):
        assert changed.key != item.key == replace(item, cells=("y",)).key


@pytest.mark.parametrize(("rank", "size"), [("2", "2"), ("-1", "2"), ("a", "2"), ("0", "0")])
def test_workers_refuses_a_bad_rank(monkeypatch, rank, size):
    monkeypatch.setenv("RANK", rank)
    monkeypatch.setenv("WORLD_SIZE", size)
    with pytest.raises(InvalidInputError, match="RANK < WORLD_SIZE"), workers():
        pass


def test_run_processes(monkeypatch, capfd):
    assert not run_processes(1, ["evaluate"])
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "x")
    assert not run_processes(2, ["evaluate"])
    monkeypatch.delenv("TORCHELASTIC_RUN_ID")
    with pytest.raises(InvalidInputError, match="a process ended with 1"):
        run_processes(2, ["nonsense"])
    assert "nonsense" in capfd.readouterr().err
